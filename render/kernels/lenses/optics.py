"""What all lens kernels share: a lens as numbers.

Everything about lenses is float64: the moments of a splat are differences of nearby pixels, which float32 loses at 4K, and what
a lens bends has no closed form free of cancellation. It is a few hundred operations a splat, nothing beside compositing.
"""

import warp as wp

PARAMS = 16
params = wp.types.vector(length=PARAMS, dtype=wp.float64)
mat23d = wp.types.matrix(shape=(2, 3), dtype=wp.float64)


@wp.struct
class Optics:
    """A lens: its parameters in the order of its type's fields, and its domain, the cone z > cos_limit |p|."""

    p: params
    cos_limit: wp.float64
    sin_limit: wp.float64
    period: wp.float64  # pixels of a whole turn, 0 for a lens that does not close on itself
    middle: wp.float64  # the picture's, along x
