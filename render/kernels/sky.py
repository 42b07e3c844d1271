"""The sky behind a picture, pixel by pixel: what `scenes.sky.sample_equirect` computes, where light passes the splats."""

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)

PI = wp.constant(3.14159265358979)


@wp.func
def looked_up(sky: wp.array2d[wp.vec3], d: wp.vec3):
    """Bilinear; columns wrap around, rows end at the poles."""
    height = sky.shape[0]
    width = sky.shape[1]
    column = (0.5 - wp.atan2(d[1], d[0]) / (2.0 * PI)) * float(width) - 0.5
    row = (0.5 - wp.atan2(d[2], wp.sqrt(d[0] * d[0] + d[1] * d[1])) / PI) * float(height) - 0.5
    row = wp.clamp(row, 0.0, float(height - 1))
    left = wp.floor(column)
    top = wp.min(wp.floor(row), float(wp.max(height - 2, 0)))
    fc = column - left
    fr = row - top
    c0 = (int(left) + width) % width
    c1 = (c0 + 1) % width
    r0 = int(top)
    r1 = wp.min(r0 + 1, height - 1)
    upper = sky[r0, c0] * (1.0 - fc) + sky[r0, c1] * fc
    lower = sky[r1, c0] * (1.0 - fc) + sky[r1, c1] * fc
    return upper * (1.0 - fr) + lower * fr


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
