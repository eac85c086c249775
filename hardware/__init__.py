"""Everything that touches time, wires or liquid.

All packages here share `reactor`, `errors` and `clock`; the docstring of each package names its users.
"""
