"""Everything that touches time, wires or liquid.

Reactor, errors and clock are what all rooms share; each room beside them says who may enter.
"""
