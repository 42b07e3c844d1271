"""Which splats a picture may show."""

import warp as wp

from render.kernels.types import OPTIONS, REACH

wp.set_module_options(OPTIONS)


@wp.func
def beyond(side: wp.vec4, x: wp.vec3, radius: float):
    return side[0] * x[0] + side[1] * x[1] + side[2] * x[2] + side[3] > radius


@wp.kernel
def mark(
    means: wp.array[wp.vec3], log_scales: wp.array[wp.vec3], sides: wp.array3d[wp.vec4], seen: wp.array[wp.uint8],
    first: int,
):  # fmt: skip
    """1 for splats that are not wholly beyond one side of every eye's view, else 0.

    sides `[E, 2, S]`: planes n x + d = 0 with unit n out of the view, as the readout begins and as it ends; between them a splat is
    beyond a side when it is so at both.
    """
    i = first + wp.tid()
    x = means[i]
    radius = REACH * wp.exp(wp.max(log_scales[i]))
    shown = wp.uint8(0)
    for e in range(sides.shape[0]):
        inside = int(1)
        for s in range(sides.shape[2]):
            if inside == 1 and beyond(sides[e, 0, s], x, radius) and beyond(sides[e, 1, s], x, radius):
                inside = 0
        if inside == 1:
            shown = wp.uint8(1)
    seen[i] = shown
