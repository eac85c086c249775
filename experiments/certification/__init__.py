"""A certificate of a learned policy: the proven band that its closed loop enters and never leaves, for every setpoint.

Numerics are pure: polygons of a network, images of intervals, a verdict. No proof depends on samples.
"""
