"""Certificate of a learned policy: for every setpoint a band is proven that the closed loop enters and never leaves.

All modules but `certificate` and `figure` are pure numerics: polygons of a network, images of intervals, proofs. No
proof depends on samples."""
