"""Splats in the canonical frames where each is the unit Gaussian (`ray_rows.py`), for those that are drawn.

`render/canonical.py` makes the same in torch, where gradients are wanted.
"""

import warp as wp

from render.kernels.fields import rotation
from render.kernels.types import BASE, COUNT, DRAW, FIRST, OPTIONS, matrix_at, vector_at

wp.set_module_options(OPTIONS)

FRAME = 16
"""Numbers of a splat's canonical frame: A row major, p, A p, and which rays look at it."""
CENTRE, MOVED, GROUP = wp.constant(9), wp.constant(12), wp.constant(15)

THINNEST = -100.0
"""ln metres: an axis is taken to be no shorter, so that squares of squares stay within float64."""

FARTHEST = 1e60
"""In a splat's own scales: one whose centre is further from the eye, or not a number, is met by no ray."""

LONGEST_AXIS = wp.constant(wp.float64(-THINNEST))
NOWHERE = wp.constant(wp.float64(FARTHEST))


@wp.kernel
def make_frames(
    means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3],
    poses: wp.array2d[wp.float64], items: wp.array2d[int], threads: int, groups: wp.array[int], counts: wp.array[int],
    frames: wp.array2d[wp.float64],
    first: int,
):  # fmt: skip
    """poses: rows that begin with the pose, at the readout's begin, as projection has them; groups: of each row, which rays look at it."""
    part = first + wp.tid()
    item = part // threads
    draw = items[item, DRAW]
    turn = matrix_at(poses, draw, 0)
    shift = vector_at(poses, draw, 9)
    one = wp.float64(1.0)
    for k in range(part % threads, items[item, COUNT], threads):
        i = items[item, FIRST] + k
        j = items[item, BASE] + k
        if counts[j] > 0:
            axes = turn * rotation(quats[i])
            p = turn * wp.vec3d(means[i]) + shift
            within = bool(True)
            for a in range(3):
                longer = wp.exp(wp.min(-wp.float64(log_scales[i][a]), LONGEST_AXIS))
                moved = wp.float64(0.0)
                for c in range(3):
                    number = longer * axes[c, a]
                    moved += number * p[c]
                    frames[j, 3 * a + c] = number
                    within = within and wp.abs(number) < NOWHERE  # not for what is no number
                frames[j, MOVED + a] = moved
                frames[j, CENTRE + a] = p[a]
                within = within and wp.abs(moved) < NOWHERE
            if not within:
                for c in range(FRAME):
                    frames[j, c] = wp.float64(0.0)
                frames[j, 0] = one
                frames[j, CENTRE + 1] = NOWHERE
                frames[j, MOVED + 1] = NOWHERE
            frames[j, GROUP] = wp.float64(groups[draw])
