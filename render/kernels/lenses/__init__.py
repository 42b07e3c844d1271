"""The lenses in Warp, one a file: pixel, Jacobian, and gradient of the parameters, in float64; the domain is `scenes.lenses`'."""

from typing import NamedTuple

import warp as wp

from render.kernels.lenses import equirectangular, fisheye, ftheta, opencv, orthographic, pinhole

PLANAR, ROUND, PARALLEL = range(3)
"""What depth means for a lens: z of what lies before it; the distance from an eye that sees all around; z without an eye."""


class LensFunctions(NamedTuple):
    """What a projection kernel is made of: pixel(optics, v), d pixel / d v, its transpose's counterpart for the parameters, and which
    depth the lens has."""

    pixel: wp.Function
    jacobian: wp.Function
    params_gradient: wp.Function
    depth: int


def _functions(lens, depth: int) -> LensFunctions:
    return LensFunctions(lens.pixel, lens.jacobian, lens.params_gradient, depth)


LENS_FUNCTIONS = {
    "pinhole": _functions(pinhole, PLANAR),
    "opencv": _functions(opencv, PLANAR),
    "fisheye": _functions(fisheye, ROUND),
    "ftheta": _functions(ftheta, ROUND),
    "equirectangular": _functions(equirectangular, ROUND),
    "orthographic": _functions(orthographic, PARALLEL),
}
"""By the lens's name in files."""
