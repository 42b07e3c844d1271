"""Choices lane by lane, and sums and greatest of all lanes, written so that each becomes a vector instruction or two.

Warp's own `min` and `max` mind NaN, which doubles them; its vectors have no comparison; and it adds lanes up one by one.
"""

import warp as wp

from render.kernels.types import lanes


@wp.func
def lesser(a: float, b: float):
    return wp.where(a < b, a, b)


@wp.func
def greater(a: float, b: float):
    return wp.where(a > b, a, b)


@wp.func
def below(limit: float, z: lanes):
    """1 where z < limit, else 0 (limit of ordinary size, z of any)."""
    return wp.min(wp.max(lanes(limit * 1.0e30) - z * 1.0e30, lanes(0.0)), lanes(1.0))


@wp.func
def before(place: float, places: lanes):
    """Those of `places`, whole numbers, that are less than `place`; -1 for the others."""
    less = wp.min(wp.max(lanes(place) - places, lanes(0.0)), lanes(1.0))
    return wp.cw_mul(less, places + lanes(1.0)) - lanes(1.0)


@wp.func
def cut(s: lanes, limit: float, v: lanes):
    """v where s < limit, else 0."""
    return lanes(
        wp.where(s[0] < limit, v[0], 0.0), wp.where(s[1] < limit, v[1], 0.0),
        wp.where(s[2] < limit, v[2], 0.0), wp.where(s[3] < limit, v[3], 0.0),
        wp.where(s[4] < limit, v[4], 0.0), wp.where(s[5] < limit, v[5], 0.0),
        wp.where(s[6] < limit, v[6], 0.0), wp.where(s[7] < limit, v[7], 0.0),
        wp.where(s[8] < limit, v[8], 0.0), wp.where(s[9] < limit, v[9], 0.0),
        wp.where(s[10] < limit, v[10], 0.0), wp.where(s[11] < limit, v[11], 0.0),
        wp.where(s[12] < limit, v[12], 0.0), wp.where(s[13] < limit, v[13], 0.0),
        wp.where(s[14] < limit, v[14], 0.0), wp.where(s[15] < limit, v[15], 0.0),
    )  # fmt: skip


@wp.func
def signed(who: lanes, instance: float, w: lanes):
    """w where `who` is the instance, else -w."""
    return lanes(
        wp.where(who[0] == instance, w[0], -w[0]), wp.where(who[1] == instance, w[1], -w[1]),
        wp.where(who[2] == instance, w[2], -w[2]), wp.where(who[3] == instance, w[3], -w[3]),
        wp.where(who[4] == instance, w[4], -w[4]), wp.where(who[5] == instance, w[5], -w[5]),
        wp.where(who[6] == instance, w[6], -w[6]), wp.where(who[7] == instance, w[7], -w[7]),
        wp.where(who[8] == instance, w[8], -w[8]), wp.where(who[9] == instance, w[9], -w[9]),
        wp.where(who[10] == instance, w[10], -w[10]), wp.where(who[11] == instance, w[11], -w[11]),
        wp.where(who[12] == instance, w[12], -w[12]), wp.where(who[13] == instance, w[13], -w[13]),
        wp.where(who[14] == instance, w[14], -w[14]), wp.where(who[15] == instance, w[15], -w[15]),
    )  # fmt: skip


@wp.func
def voted(who: lanes, lead: lanes, instance: float, w: lanes):
    """The instance that leads, and by how much, when one more splat has voted by its weight (`types.WHO`)."""
    left = lead + signed(who, instance, w)
    return who + cut(left, 0.0, lanes(instance) - who), left - 2.0 * cut(left, 0.0, left)


@wp.func
def least(v: lanes, limit: float):
    """The lesser of v and limit."""
    return lanes(
        lesser(v[0], limit), lesser(v[1], limit), lesser(v[2], limit), lesser(v[3], limit),
        lesser(v[4], limit), lesser(v[5], limit), lesser(v[6], limit), lesser(v[7], limit),
        lesser(v[8], limit), lesser(v[9], limit), lesser(v[10], limit), lesser(v[11], limit),
        lesser(v[12], limit), lesser(v[13], limit), lesser(v[14], limit), lesser(v[15], limit),
    )  # fmt: skip


@wp.func
def greatest(a: lanes, b: lanes):
    """The greater of both, or 0 where neither is positive."""
    return lanes(
        greater(greater(a[0], b[0]), 0.0), greater(greater(a[1], b[1]), 0.0),
        greater(greater(a[2], b[2]), 0.0), greater(greater(a[3], b[3]), 0.0),
        greater(greater(a[4], b[4]), 0.0), greater(greater(a[5], b[5]), 0.0),
        greater(greater(a[6], b[6]), 0.0), greater(greater(a[7], b[7]), 0.0),
        greater(greater(a[8], b[8]), 0.0), greater(greater(a[9], b[9]), 0.0),
        greater(greater(a[10], b[10]), 0.0), greater(greater(a[11], b[11]), 0.0),
        greater(greater(a[12], b[12]), 0.0), greater(greater(a[13], b[13]), 0.0),
        greater(greater(a[14], b[14]), 0.0), greater(greater(a[15], b[15]), 0.0),
    )  # fmt: skip


@wp.func
def largest(v: lanes):
    """The largest lane of numbers that are not negative."""
    a = greater(greater(greater(v[0], v[8]), greater(v[4], v[12])), greater(greater(v[2], v[10]), greater(v[6], v[14])))
    b = greater(greater(greater(v[1], v[9]), greater(v[5], v[13])), greater(greater(v[3], v[11]), greater(v[7], v[15])))
    return greater(a, b)


@wp.func
def lesser_of(a: lanes, b: lanes):
    """The lesser of both."""
    return lanes(
        lesser(a[0], b[0]), lesser(a[1], b[1]), lesser(a[2], b[2]), lesser(a[3], b[3]),
        lesser(a[4], b[4]), lesser(a[5], b[5]), lesser(a[6], b[6]), lesser(a[7], b[7]),
        lesser(a[8], b[8]), lesser(a[9], b[9]), lesser(a[10], b[10]), lesser(a[11], b[11]),
        lesser(a[12], b[12]), lesser(a[13], b[13]), lesser(a[14], b[14]), lesser(a[15], b[15]),
    )  # fmt: skip


@wp.func
def greater_of(a: lanes, b: lanes):
    """The greater of both."""
    return -lesser_of(-a, -b)


@wp.func
def smallest(v: lanes):
    """The smallest lane."""
    a = lesser(lesser(lesser(v[0], v[8]), lesser(v[4], v[12])), lesser(lesser(v[2], v[10]), lesser(v[6], v[14])))
    b = lesser(lesser(lesser(v[1], v[9]), lesser(v[5], v[13])), lesser(lesser(v[3], v[11]), lesser(v[7], v[15])))
    return lesser(a, b)


@wp.func
def roots(v: lanes):
    """The square root of each lane."""
    return lanes(
        wp.sqrt(v[0]), wp.sqrt(v[1]), wp.sqrt(v[2]), wp.sqrt(v[3]), wp.sqrt(v[4]), wp.sqrt(v[5]), wp.sqrt(v[6]), wp.sqrt(v[7]),
        wp.sqrt(v[8]), wp.sqrt(v[9]), wp.sqrt(v[10]), wp.sqrt(v[11]), wp.sqrt(v[12]), wp.sqrt(v[13]), wp.sqrt(v[14]), wp.sqrt(v[15]),
    )  # fmt: skip


@wp.func
def total(v: lanes):
    """The sum of all lanes."""
    a = ((v[0] + v[8]) + (v[4] + v[12])) + ((v[2] + v[10]) + (v[6] + v[14]))
    b = ((v[1] + v[9]) + (v[5] + v[13])) + ((v[3] + v[11]) + (v[7] + v[15]))
    return a + b


@wp.func
def total_at(quarters: wp.array[wp.vec4], at: int):
    """The sum of all lanes of the vector `at` of an array that is seen as quarters of vectors."""
    v = (quarters[4 * at] + quarters[4 * at + 1]) + (quarters[4 * at + 2] + quarters[4 * at + 3])
    return (v[0] + v[1]) + (v[2] + v[3])
