"""Points of several groups carried by their group's matrix, for pictures whose rows are read one after the other."""

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)


@wp.func
def group_of(i: int, ends: wp.array[int]):
    """The first group that ends behind place i."""
    low = int(0)
    high = ends.shape[0] - 1
    while low < high:
        middle = (low + high) / 2
        if i < ends[middle]:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def carried(x: wp.vec3, by: wp.array3d[float], g: int, k: int):
    y = wp.vec3()
    for r in range(3):
        y[r] = by[g, 4 * k + r, 0] * x[0] + by[g, 4 * k + r, 1] * x[1] + by[g, 4 * k + r, 2] * x[2] + by[g, 4 * k + r, 3]
    return y


@wp.kernel
def carry(
    points: wp.array[wp.vec3], ends: wp.array[int], by: wp.array3d[float], near: float, seen: wp.array[wp.vec3], moved: wp.array[wp.vec3],
    first: int,
):  # fmt: skip
    """seen: where points are by the upper four rows of `by` `[P, 7, 4]`, and moved: by the lower three, each by its group's, which ends at
    `ends` `[P]`. What is then no farther than `near` is seen anywhere and moves by nothing."""
    i = first + wp.tid()
    g = group_of(i, ends)
    x = points[i]
    y = carried(x, by, g, 0)
    z = carried(x, by, g, 1)
    if y[2] <= near:
        y = wp.vec3(1.0, 1.0, 1.0)
        z = wp.vec3()
    seen[i] = y
    moved[i] = z
