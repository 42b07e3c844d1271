"""What planes cost, summed along paths over a picture (Hirschmüller 2008, equation 13)."""

import warp as wp

from recon.kernels.planes import CHUNKS
from render.kernels.lanewise import lesser_of, smallest
from render.kernels.types import OPTIONS, lanes

wp.set_module_options(OPTIONS)

FAR = wp.constant(1.0e9)  # costs less than nothing else does


@wp.struct
class Lines:
    """Parallel lines over the pixels, in their order: how far from one to the next, how far from pixel to pixel of one, and of how many.
    What it costs a pixel to be one plane off the one before it, or any number; and at how many levels between them that costs half."""

    beside: int
    step: int
    count: int
    nudge: float
    jump: float
    edge: float


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
    lines: Lines, cost: wp.array2d[lanes], grey: wp.array[float], begun: int, path: wp.array2d[lanes], total: wp.array2d[lanes],
    first: int,
):  # fmt: skip
    """What `cost` comes to along lines, an item each, there and back: added to `total` `[h w, CHUNKS]` where that is begun. path: a row
    each, to work in."""
    i = first + wp.tid()
    for back in range(2):
        for k in range(CHUNKS):
            path[i, k] = lanes(0.0)
        least = float(0.0)
        jump = float(0.0)  # the first pixel has nothing before it
        kept = wp.where(begun + back > 0, 1.0, 0.0)
        step = wp.where(back == 1, -lines.step, lines.step)
        at = i * lines.beside + back * (lines.count - 1) * lines.step
        for n in range(lines.count):
            elsewhere = lanes(least + jump)
            lowest = lanes(FAR)
            last = FAR
            here = path[i, 0]
            for k in range(CHUNKS):
                following = lanes(FAR)
                if k + 1 < CHUNKS:
                    following = path[i, k + 1]
                beside = lesser_of(behind(last, here), ahead(here, following[0])) + lanes(lines.nudge)
                now = cost[at, k] + (lesser_of(lesser_of(here, elsewhere), beside) - lanes(least))
                path[i, k] = now
                lowest = lesser_of(lowest, now)
                total[at, k] = now + total[at, k] * kept
                last = here[15]
                here = following
            least = smallest(lowest)
            if n + 1 < lines.count:
                jump = lines.jump / (1.0 + wp.abs(grey[at + step] - grey[at]) / lines.edge)
            at += step
