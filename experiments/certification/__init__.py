"""A certificate of a learned policy: the band that its closed loop enters and never leaves, proven for every setpoint.

Numerics are pure: a network cut into polygons, images of intervals, a verdict. No proof rests on a sample.
"""
