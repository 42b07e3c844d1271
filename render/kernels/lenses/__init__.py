"""The lenses in Warp, one a file: pixel, Jacobian, and gradient of the parameters, in float64."""
