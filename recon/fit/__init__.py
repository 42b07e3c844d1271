"""The fit: splats, sky, poses, clocks, exposures and limbs, by gradient descent on the photos."""
