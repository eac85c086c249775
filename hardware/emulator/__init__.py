"""A Chi.Bio in software: its threads, timing and faults, around simulated vials.

`python -m hardware.emulator` serves it over HTTP; tests and rehearsals call it in the same process."""
