"""What planes cost, summed along paths over a picture (Hirschmüller 2008, equation 13)."""

import warp as wp

from recon.kernels.planes import CHUNKS, lesser_of
from render.kernels.lanewise import lesser
from render.kernels.types import OPTIONS, lanes

wp.set_module_options(OPTIONS)

FAR = wp.constant(1.0e9)  # costs less than nothing else does


@wp.struct
class Paths:
    """Parallel paths over the pixels, in their order: where the first begins, how far on the next does, how far a path's next pixel is, and
    how many a path has. What it costs a pixel to be one plane off the one before it, or any number; and at how many levels between them that
    costs half."""

    start: int
    beside: int
    step: int
    count: int
    nudge: float
    jump: float
    edge: float


@wp.func
def smallest(v: lanes):
    a = lesser(lesser(lesser(v[0], v[8]), lesser(v[4], v[12])), lesser(lesser(v[2], v[10]), lesser(v[6], v[14])))
    b = lesser(lesser(lesser(v[1], v[9]), lesser(v[5], v[13])), lesser(lesser(v[3], v[11]), lesser(v[7], v[15])))
    return lesser(a, b)


@wp.func
def behind(a: float, v: lanes):
    """What stands before each lane, before the first a."""
    return lanes(a, v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10], v[11], v[12], v[13], v[14])


@wp.func
def ahead(v: lanes, a: float):
    """What follows each lane, the last one a."""
    return lanes(v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8], v[9], v[10], v[11], v[12], v[13], v[14], v[15], a)


@wp.kernel
def add_paths(
    paths: Paths, cost: wp.array2d[lanes], grey: wp.array[float], path: wp.array2d[lanes], total: wp.array2d[lanes],
    first: int,
):  # fmt: skip
    """Add to `total` `[h w, CHUNKS]` what `cost` comes to along paths, an item each; path: a row each, to work in."""
    i = first + wp.tid()
    for k in range(CHUNKS):
        path[i, k] = lanes(0.0)
    least = float(0.0)
    jump = float(0.0)  # the first pixel has nothing before it
    at = paths.start + i * paths.beside
    for n in range(paths.count):
        elsewhere = lanes(least + jump)
        lowest = lanes(FAR)
        last = FAR
        here = path[i, 0]
        for k in range(CHUNKS):
            following = lanes(FAR)
            if k + 1 < CHUNKS:
                following = path[i, k + 1]
            beside = lesser_of(behind(last, here), ahead(here, following[0])) + lanes(paths.nudge)
            now = cost[at, k] + (lesser_of(lesser_of(here, elsewhere), beside) - lanes(least))
            path[i, k] = now
            total[at, k] = total[at, k] + now
            lowest = lesser_of(lowest, now)
            last = here[15]
            here = following
        least = smallest(lowest)
        if n + 1 < paths.count:
            jump = paths.jump / (1.0 + wp.abs(grey[at + paths.step] - grey[at]) / paths.edge)
        at += paths.step
