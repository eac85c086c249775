"""A Chi.Bio in software, down to its threads, timing and faults, in front of a simulated vial.

`python -m hardware.emulator` serves it over HTTP; tests and rehearsals call it in the same process."""
