"""Adam for the splats that a picture may show, and what else a step does to them, in one pass over their memory."""

import math

import warp as wp

from render.kernels.types import OPTIONS

wp.set_module_options(OPTIONS)

BETA1, BETA2 = 0.9, 0.999
FIRST, SECOND = wp.constant(BETA1), wp.constant(BETA2)
LOG_FIRST, LOG_SECOND = wp.constant(math.log(BETA1)), wp.constant(math.log(BETA2))
COASTING = wp.constant(BETA1 / math.sqrt(BETA2))  # what a step without a gradient keeps of the one before
TINY = wp.constant(1.0e-15)


@wp.struct
class Rates:
    """The steps of the fields; what corrects the moments' bias; limits of scales, in parts of a splat's reach and of its middle scale."""

    means: float
    quats: float
    log_scales: float
    logits: float
    colours: float
    harmonics: float
    fade: float  # logit that a splat loses each time it is seen
    now: float  # which step this is, from 1
    unbias1: float
    unbias2: float
    log_largest: float
    log_thinnest: float
    log_longest: float


@wp.func
def downhill(m: float, v: float, rates: Rates):
    return -m * rates.unbias1 / (wp.sqrt(v * rates.unbias2) + TINY)


@wp.func
def step(g: float, moments: wp.array3d[float], i: int, c: int, rates: Rates):
    """One step's way in units of its rate (Kingma and Ba 2015), and the moments after it."""
    m = FIRST * moments[i, 0, c] + (1.0 - FIRST) * g
    v = SECOND * moments[i, 1, c] + (1.0 - SECOND) * g * g
    moments[i, 0, c] = m
    moments[i, 1, c] = v
    return downhill(m, v, rates)


@wp.struct
class Coast:
    """Steps without a gradient: the sum of their ways against the last one's, and what they leave of the moments."""

    way: float
    first: float
    second: float


@wp.func
def coasted(moments: wp.array3d[float], i: int, c: int, coast: Coast, rates: Rates):
    m = moments[i, 0, c]
    v = moments[i, 1, c]
    moments[i, 0, c] = coast.first * m
    moments[i, 1, c] = coast.second * v
    return coast.way * downhill(m, v, rates)


@wp.func
def limited(scales: wp.vec3, reach: float, rates: Rates):
    """Log scales within what the cameras can tell."""
    limit = wp.log(reach)
    for c in range(3):
        scales[c] = wp.clamp(scales[c], limit + rates.log_thinnest, limit + rates.log_largest)
    middle = scales[0] + scales[1] + scales[2] - wp.max(scales) - wp.min(scales)
    for c in range(3):
        scales[c] = wp.min(scales[c], middle + rates.log_longest)
    return scales


@wp.kernel
def catch_up(
    which: wp.array[wp.int64], rates: Rates, coefficients: int,
    means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3], logits: wp.array[float], sh: wp.array2d[wp.vec3],
    reach: wp.array[float], moments: wp.array3d[float], last: wp.array[float],
    first: int,
):  # fmt: skip
    """Splats as they are when they have also taken the steps since their last, in which no picture pulled at them."""
    i = int(which[first + wp.tid()])
    missed = rates.now - 1.0 - last[i]
    if missed > 0.0:
        last[i] = rates.now - 1.0
        coast = Coast()
        coast.way = COASTING * (1.0 - wp.exp(missed * wp.log(COASTING))) / (1.0 - COASTING)
        coast.first = wp.exp(missed * LOG_FIRST)
        coast.second = wp.exp(missed * LOG_SECOND)
        move = wp.vec3()
        grow = wp.vec3()
        turn = wp.vec4()
        for c in range(3):
            move[c] = coasted(moments, i, c, coast, rates)
            grow[c] = coasted(moments, i, 7 + c, coast, rates)
        for c in range(4):
            turn[c] = coasted(moments, i, 3 + c, coast, rates)
        means[i] = means[i] + rates.means * reach[i] * move
        quats[i] = quats[i] + rates.quats * turn
        logits[i] = logits[i] + rates.logits * coasted(moments, i, 10, coast, rates)
        for s in range(coefficients):
            shade = wp.vec3()
            for c in range(3):
                shade[c] = coasted(moments, i, 11 + 3 * s + c, coast, rates)
            sh[i, s] = sh[i, s] + wp.where(s == 0, rates.colours, rates.harmonics) * shade
        log_scales[i] = limited(log_scales[i] + rates.log_scales * grow, reach[i], rates)


@wp.kernel
def descend(
    which: wp.array[wp.int64], rates: Rates,
    g_means: wp.array[wp.vec3], g_quats: wp.array[wp.vec4], g_log_scales: wp.array[wp.vec3], g_logits: wp.array[float],
    g_sh: wp.array2d[wp.vec3],
    means: wp.array[wp.vec3], quats: wp.array[wp.vec4], log_scales: wp.array[wp.vec3], logits: wp.array[float], sh: wp.array2d[wp.vec3],
    reach: wp.array[float], moments: wp.array3d[float], last: wp.array[float], pull: wp.array[float], pulled: wp.array[float],
    first: int,
):  # fmt: skip
    """Row k of the gradients is splat which[k]'s; those without a gradient were hidden, and catch up when they are shown again."""
    k = first + wp.tid()
    i = int(which[k])
    size = wp.length(g_means[k]) * reach[i]
    if size > 0.0:
        pull[i] = pull[i] + size
        pulled[i] = pulled[i] + 1.0
    if size > 0.0 or g_logits[k] != 0.0:  # what closes a gap on the ground is not pulled from its place
        last[i] = rates.now
        move = wp.vec3()
        grow = wp.vec3()
        turn = wp.vec4()
        for c in range(3):
            move[c] = step(g_means[k][c], moments, i, c, rates)
            grow[c] = step(g_log_scales[k][c], moments, i, 7 + c, rates)
        for c in range(4):
            turn[c] = step(g_quats[k][c], moments, i, 3 + c, rates)
        # Adam's step has one length for all; a far splat must move further to move a pixel
        means[i] = means[i] + rates.means * reach[i] * move
        quats[i] = quats[i] + rates.quats * turn
        logits[i] = logits[i] + rates.logits * step(g_logits[k], moments, i, 10, rates) - rates.fade
        for s in range(g_sh.shape[1]):
            shade = wp.vec3()
            for c in range(3):
                shade[c] = step(g_sh[k, s][c], moments, i, 11 + 3 * s + c, rates)
            sh[i, s] = sh[i, s] + wp.where(s == 0, rates.colours, rates.harmonics) * shade
        log_scales[i] = limited(log_scales[i] + rates.log_scales * grow, reach[i], rates)
