"""The vendor's own software around simulated vials, on one computer and without hardware: `python -m` starts it."""
