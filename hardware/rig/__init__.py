"""The vendor's software with simulated vials, on one computer and without hardware; `python -m hardware.rig`."""
