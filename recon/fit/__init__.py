"""The fit: splats, sky, poses, clocks, exposures and limbs, by gradient descent on the photos."""

from recon.fit.config import FitConfig

__all__ = ["FitConfig"]
