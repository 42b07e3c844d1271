"""Sky behind a picture and its camera's exposure over it, and the way back: a thread takes the rows between two rows of sky samples."""

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)

SKY_STEP = 8
"""Pixels between sky samples."""
STEP = wp.constant(SKY_STEP)


@wp.func
def before(cell: int):
    """The sample at or before the pixels of a cell, which lie between the middles of two samples; the first ones before any."""
    return wp.max(cell - 1, 0)


@wp.func
def share(pixel: int, sample: int):
    """Of the sample after `sample`, at a pixel of the sampled grid."""
    return wp.clamp((float(pixel) + 0.5) / float(STEP) - 0.5 - float(sample), 0.0, 1.0)


@wp.kernel
def develop(
    rgb: wp.array3d[float], alpha: wp.array2d[float], sky: wp.array2d[wp.vec3], top: int, left: int, exposure: wp.array2d[float],
    out: wp.array2d[wp.vec3],
    first: int,
):  # fmt: skip
    """out = E[:, :3] (rgb + (1 - alpha) sky) + E[:, 3]; the picture begins at pixel (top, left) of the sampled grid."""
    row = first + wp.tid()
    height = alpha.shape[0]
    width = alpha.shape[1]
    e = exposure
    mix = wp.mat33(e[0, 0], e[0, 1], e[0, 2], e[1, 0], e[1, 1], e[1, 2], e[2, 0], e[2, 1], e[2, 2])
    offset = wp.vec3(e[0, 3], e[1, 3], e[2, 3])
    r = before(row)
    below = wp.min(r + 1, sky.shape[0] - 1)
    for y in range(wp.max(STEP * row - STEP / 2 - top, 0), wp.min(STEP * row + STEP / 2 - top, height)):
        down = share(y + top, r)
        for column in range(sky.shape[1] + 1):
            c = before(column)
            right = wp.min(c + 1, sky.shape[1] - 1)
            here = sky[r, c] * (1.0 - down) + sky[below, c] * down
            there = sky[r, right] * (1.0 - down) + sky[below, right] * down
            for x in range(wp.max(STEP * column - STEP / 2 - left, 0), wp.min(STEP * column + STEP / 2 - left, width)):
                along = share(x + left, c)
                behind = here * (1.0 - along) + there * along
                seen = wp.vec3(rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2]) + (1.0 - alpha[y, x]) * behind
                out[y, x] = mix * seen + offset


@wp.kernel
def develop_backward(
    rgb: wp.array3d[float], alpha: wp.array2d[float], sky: wp.array2d[wp.vec3], top: int, left: int, exposure: wp.array2d[float],
    g_out: wp.array2d[wp.vec3],
    g_rgb: wp.array3d[float], g_alpha: wp.array2d[float], g_sky: wp.array3d[wp.vec3], g_exposure: wp.array2d[float],
    first: int,
):  # fmt: skip
    """g_rgb `[3, H, W]`; g_sky `[rows, 2, w]`: of each thread's upper and lower row of samples; g_exposure `[rows, 12]`."""
    row = first + wp.tid()
    height = alpha.shape[0]
    width = alpha.shape[1]
    e = exposure
    back = wp.mat33(e[0, 0], e[1, 0], e[2, 0], e[0, 1], e[1, 1], e[2, 1], e[0, 2], e[1, 2], e[2, 2])
    g_mix = wp.mat33()
    g_offset = wp.vec3()
    r = before(row)
    below = wp.min(r + 1, sky.shape[0] - 1)
    for y in range(wp.max(STEP * row - STEP / 2 - top, 0), wp.min(STEP * row + STEP / 2 - top, height)):
        down = share(y + top, r)
        for column in range(sky.shape[1] + 1):
            c = before(column)
            right = wp.min(c + 1, sky.shape[1] - 1)
            here = sky[r, c] * (1.0 - down) + sky[below, c] * down
            there = sky[r, right] * (1.0 - down) + sky[below, right] * down
            g_here = wp.vec3()
            g_there = wp.vec3()
            for x in range(wp.max(STEP * column - STEP / 2 - left, 0), wp.min(STEP * column + STEP / 2 - left, width)):
                along = share(x + left, c)
                behind = here * (1.0 - along) + there * along
                through = 1.0 - alpha[y, x]
                seen = wp.vec3(rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2]) + through * behind
                g = g_out[y, x]
                g_mix += wp.outer(g, seen)
                g_offset += g
                g_seen = back * g
                g_rgb[0, y, x] = g_seen[0]
                g_rgb[1, y, x] = g_seen[1]
                g_rgb[2, y, x] = g_seen[2]
                g_alpha[y, x] = -wp.dot(g_seen, behind)
                g_here += (through * (1.0 - along)) * g_seen
                g_there += (through * along) * g_seen
            g_sky[row, 0, c] = g_sky[row, 0, c] + (1.0 - down) * g_here
            g_sky[row, 1, c] = g_sky[row, 1, c] + down * g_here
            g_sky[row, 0, right] = g_sky[row, 0, right] + (1.0 - down) * g_there
            g_sky[row, 1, right] = g_sky[row, 1, right] + down * g_there
    for i in range(3):
        for j in range(3):
            g_exposure[row, 4 * i + j] = g_mix[i, j]
        g_exposure[row, 4 * i + 3] = g_offset[i]
