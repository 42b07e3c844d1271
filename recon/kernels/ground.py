"""Rays marched until they are under a height grid."""

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)

NONE, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))


@wp.struct
class Grid:
    """Where the heights of a `scenes.ground.Ground` are."""

    x: wp.float64
    y: wp.float64
    cell: wp.float64


@wp.func
def height(heights: wp.array2d[float], grid: Grid, p: wp.vec3d):
    """As `Ground.height`."""
    rows = heights.shape[0]
    columns = heights.shape[1]
    x = wp.clamp((p[0] - grid.x) / grid.cell, NONE, wp.float64(columns - 1))
    y = wp.clamp((p[1] - grid.y) / grid.cell, NONE, wp.float64(rows - 1))
    c = wp.min(int(x), columns - 2)
    r = wp.min(int(y), rows - 2)
    u = x - wp.float64(c)
    v = y - wp.float64(r)
    near = wp.float64(heights[r, c]) * (ONE - u) + wp.float64(heights[r, c + 1]) * u
    far = wp.float64(heights[r + 1, c]) * (ONE - u) + wp.float64(heights[r + 1, c + 1]) * u
    return near * (ONE - v) + far * v


@wp.func
def above(heights: wp.array2d[float], grid: Grid, eye: wp.vec3d, ray: wp.vec3d, times: wp.float64):
    at = eye + times * ray
    return at[2] - height(heights, grid, at)


@wp.kernel
def march(
    heights: wp.array2d[float], grid: Grid, slope: wp.vec2d, eye: wp.vec3d, rays: wp.array[wp.vec3d], steps: wp.array[wp.float64],
    rounds: int, level: wp.float64, hits: wp.array[wp.float64],
    first: int,
):  # fmt: skip
    """hits: multiples of rays, of those that fall by more than `level`, or do against ground of a `slope` along x and y, at which they come
    to the field: between the first two of `steps`, from the eye on, that are above and under it, by `rounds` of false position. Infinite
    where there are none."""
    i = first + wp.tid()
    ray = rays[i]
    hits[i] = wp.float64(wp.inf)
    near = wp.float64(0.0)
    over = above(heights, grid, eye, ray, near)
    if ray[2] < wp.max(NONE, slope[0] * ray[0] + slope[1] * ray[1]) - level and over > NONE:
        n = int(0)
        far = steps[0]
        under = above(heights, grid, eye, ray, far)
        while under > NONE and n + 1 < steps.shape[0]:
            near = far
            over = under
            n += 1
            far = steps[n]
            under = above(heights, grid, eye, ray, far)
        if under <= NONE:
            for _round in range(rounds):
                hit = near + over / (over - under) * (far - near)
                now = above(heights, grid, eye, ray, hit)
                if now > NONE:
                    near = hit
                    over = now
                else:
                    far = hit
                    under = now
                hits[i] = hit
