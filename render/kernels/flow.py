"""Where what a pixel shows stands for another camera, and what of a picture there it sees."""

from functools import cache

import warp as wp

from render.kernels.lenses import ROUND, LensFunctions
from render.kernels.lenses.optics import Optics
from render.kernels.types import OPTIONS, pixel_of, pixels_of

wp.set_module_options(OPTIONS)


@cache
def carry_kernel(lens: LensFunctions) -> wp.Kernel:
    """The kernel that carries the surface points of a picture to where they stand for another camera, which has this lens."""
    pixel, around = lens.pixel, lens.depth == ROUND

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def carry(
        rays: wp.array2d[wp.vec3], origins: wp.array2d[wp.vec3], left: int, top: int,
        bends: wp.array2d[wp.vec3], depth: wp.array2d[float], instance: wp.array2d[int], place: wp.array[int],
        ways: wp.array3d[wp.mat44d], by_columns: int, shares: wp.array2d[wp.float64], optics: Optics,
        pixels: wp.array2d[wp.vec2d], flow: wp.array2d[wp.vec2], depths: wp.array2d[float],
        stretch: int, first: int,
    ):  # fmt: skip
        """bends: how far a point moves within its instance, seen from here. ways[place[instance], k, line]: coefficient of the k-th power
        of the share; the line is the pixel's row or column where each has its own. The last of the ways is the sky's, which only turns.
        depths: the points' own in the other camera, inf for the sky."""
        begin, end = pixels_of(first + wp.tid(), stretch, depth.shape[0], depth.shape[1])
        for item in range(begin, end):
            row, column = pixel_of(item, depth.shape[1])
            powers = ways.shape[1]
            line = int(0)
            if ways.shape[2] > 1:
                line = wp.where(by_columns != 0, column, row)
            ray = wp.vec3d(rays[top + row, left + column])
            i = place[wp.max(instance[row, column], -1) + 1]
            sky = instance[row, column] < 0 or depth[row, column] == wp.inf
            if sky:
                i = ways.shape[0] - 1
            else:
                ray = wp.float64(depth[row, column]) * ray
            start = wp.vec3d()  # of the sky only the way there counts
            if not sky:
                start = wp.vec3d(origins[wp.min(top + row, origins.shape[0] - 1), wp.min(left + column, origins.shape[1] - 1)])
            bend = bends[wp.min(row, bends.shape[0] - 1), wp.min(column, bends.shape[1] - 1)]
            p = start + ray + wp.vec3d(bend)
            v = wp.transform_point(ways[i, powers - 1, line], p)
            for k in range(1, powers):
                v = wp.transform_point(ways[i, powers - 1 - k, line], p) + shares[row, column] * v
            distance = wp.length(v)
            to = wp.vec2d(wp.float64(wp.nan), wp.float64(wp.nan))
            if v[2] > optics.cos_limit * distance and wp.length_sq(ray) > wp.float64(0.0):
                to = pixel(optics, v)
                if optics.period > wp.float64(0.0):
                    to[0] = to[0] + wp.round((optics.middle - to[0]) / optics.period) * optics.period
            pixels[row, column] = to
            here = wp.vec2d(wp.float64(left + column) + wp.float64(0.5), wp.float64(top + row) + wp.float64(0.5))
            flow[row, column] = wp.vec2(to - here)
            far = v[2]
            if wp.static(around):
                far = distance
            depths[row, column] = wp.where(sky, wp.inf, float(far))

    return carry


@wp.func
def shows(at: wp.vec2d, depth: float, hides: float, there: wp.array2d[float]):
    """Whether a point at `depth` falls into the picture `there`, whose four pixels around it show nothing nearer by `hides`."""
    far = float(-wp.inf)
    zero = wp.float64(0.0)
    if at[0] >= zero and at[1] >= zero and at[0] <= wp.float64(there.shape[1]) and at[1] <= wp.float64(there.shape[0]):
        right = int(at[0] + wp.float64(0.5))
        below = int(at[1] + wp.float64(0.5))
        for v in range(2):
            line = wp.clamp(below + v - 1, 0, there.shape[0] - 1)
            for u in range(2):
                far = wp.max(far, there[line, wp.clamp(right + u - 1, 0, there.shape[1] - 1)])
    return far >= (1.0 - hides) * depth


@wp.kernel
def see(
    pixels: wp.array2d[wp.vec2d], depths: wp.array2d[float], hides: float, there: wp.array2d[float], seen: wp.array2d[wp.bool],
    stretch: int, first: int,
):  # fmt: skip
    """Which points show there: `shows`."""
    begin, end = pixels_of(first + wp.tid(), stretch, seen.shape[0], seen.shape[1])
    for item in range(begin, end):
        row, column = pixel_of(item, pixels.shape[1])
        seen[row, column] = shows(pixels[row, column], depths[row, column], hides, there)
