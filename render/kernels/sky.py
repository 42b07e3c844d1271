"""The sky behind a picture, pixel by pixel: what `scenes.sky.sample_equirect` computes, where light passes the splats."""

import warp as wp

from render.kernels.equirect import corners
from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def looked_up(sky: wp.array2d[wp.vec3], d: wp.vec3):
    """Bilinear."""
    k, f = corners(d, sky.shape[0], sky.shape[1])
    upper = sky[k[0], k[2]] * (1.0 - f[0]) + sky[k[0], k[3]] * f[0]
    lower = sky[k[1], k[2]] * (1.0 - f[0]) + sky[k[1], k[3]] * f[0]
    return upper * (1.0 - f[1]) + lower * f[1]


@wp.kernel
def lay_behind(
    rays: wp.array2d[wp.vec3], turns: wp.array[wp.mat33], axis: int, sky: wp.array2d[wp.vec3], shows: float,
    rgb: wp.array3d[float], alpha: wp.array2d[float], out: wp.array3d[float],
    first: int,
):  # fmt: skip
    """A thread takes a row: out `[H, W, 3]` is rgb, and where alpha < 1 - shows, the sky behind it.

    turns: the camera's rotations `[1]`, by column (axis 0) or by row (axis 1); rays 0 0 0 lead nowhere.
    """
    y = first + wp.tid()
    for x in range(rays.shape[1]):
        through = 1.0 - alpha[y, x]
        ray = rays[y, x]
        colour = wp.vec3(rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2])
        if through > shows and wp.dot(ray, ray) > 0.0:
            turn = int(0)
            if turns.shape[0] > 1:
                turn = wp.where(axis == 0, x, y)
            colour += through * looked_up(sky, turns[turn] * ray)
        for c in range(3):
            out[y, x, c] = colour[c]
