"""What one pixel sees of a splat, for CUDA, where a thread is a pixel: as `ray_rows.py` has it for a row.

A tile's size is a parameter of all that is made here and in `composite_cuda.py`, `composite_cuda_order.py`: with tiles of one pixel and
blocks of one thread the same kernels run on the CPU, where the tests hold them against the lane kernels and the oracle.
"""

from functools import cache

import warp as wp

from render.kernels.canonical import CENTRE, GROUP, MOVED
from render.kernels.ray_rows import LEAST
from render.kernels.types import (
    BLUE,
    G_BLUE,
    G_GREEN,
    G_H,
    G_K,
    G_M,
    G_OPACITY,
    G_RED,
    G_X,
    G_Y,
    G_Z,
    GRADIENTS,
    GREEN,
    INSTANCE,
    MEDIAN,
    OPACITY,
    RED,
    S_MAX,
    WHO,
    X_REST,
    Y_REST,
    H,
    K,
    M,
    Wanted,
    Window,
    X,
    Y,
    Z,
)

OPTIONS = {"enable_backward": False}
NONE = wp.constant(wp.float64(0.0))
FRAME_GRADIENTS = 12
"""Of A row major and p."""

vec_gradients = wp.types.vector(length=GRADIENTS, dtype=wp.float32)
vec_frame = wp.types.vector(length=FRAME_GRADIENTS, dtype=wp.float64)


@cache
def pixel_of(tile_size: int):
    """The function that says where a thread's pixel lies: column and row in its window, and its centre in the image."""

    @wp.func
    def pixel(window: Window, tile: int, thread: int):
        px = (tile % window.tiles_x) * wp.static(tile_size) + thread % wp.static(tile_size)
        py = (tile // window.tiles_x) * wp.static(tile_size) + thread // wp.static(tile_size)
        x = float(window.left * wp.static(tile_size) + px) + 0.5
        y = float(window.top * wp.static(tile_size) + py) + 0.5
        return px, py, x, y

    return pixel


@wp.func
def from_ridge(records: wp.array2d[float], i: int, x: float, y: float):
    """dx - M dy and dy of the pixel centre x, y."""
    dy = (y - records[i, Y]) - records[i, Y_REST]
    return (x - records[i, X]) - records[i, X_REST] - records[i, M] * dy, dy


@wp.func
def ray_at(rays: wp.array4d[wp.float64], group: int, first: int, x: float, y: float):
    """Three numbers of the ray through the pixel centre x, y; beyond the image's edge, of the last one within."""
    row = wp.min(int(y), rays.shape[2] - 1)
    column = wp.min(int(x), rays.shape[3] - 1)
    return wp.vec3d(rays[group, first, row, column], rays[group, first + 1, row, column], rays[group, first + 2, row, column])


@wp.func
def frame_of(frames: wp.array2d[wp.float64], i: int):
    """A of splat i."""
    return wp.mat33d(
        frames[i, 0], frames[i, 1], frames[i, 2],
        frames[i, 3], frames[i, 4], frames[i, 5],
        frames[i, 6], frames[i, 7], frames[i, 8],
    )  # fmt: skip


@cache
def pixel_functions(ray: bool, eyes: bool):
    """How a pixel looks at splat i: `canonical`, its ray in the splat's frame, u and q, and `faded`, exp(-s) within the cutoff and 0 beyond
    it, by the conic or along the ray. eyes: as of `ray_functions`."""

    @wp.func
    def canonical(frames: wp.array2d[wp.float64], rays: wp.array4d[wp.float64], i: int, x: float, y: float):
        a = frame_of(frames, i)
        group = int(0)
        q = wp.vec3d(frames[i, MOVED], frames[i, MOVED + 1], frames[i, MOVED + 2])
        if wp.static(eyes):
            group = int(frames[i, GROUP])
            q = q - a * ray_at(rays, group, 3, x, y)
        return a * ray_at(rays, group, 0, x, y), q

    @wp.func
    def faded(records: wp.array2d[float], frames: wp.array2d[wp.float64], rays: wp.array4d[wp.float64], i: int, x: float, y: float):
        s = float(0.0)
        if wp.static(ray):
            u, q = canonical(frames, rays, i, x, y)
            along = wp.dot(u, q)
            m = q - (along / wp.max(wp.dot(u, u), LEAST)) * u
            s = float(wp.dot(m, m) * wp.float64(0.5))
            # neither behind the ray's begin, nor on the other side of an image that closes on itself
            if not (along > NONE and wp.abs(x - records[i, X]) < records[i, X_REST]):
                s = records[i, S_MAX]
        else:
            offset, dy = from_ridge(records, i, x, y)
            u = offset * records[i, K]
            s = u * u + records[i, H] * dy * dy
        e = float(0.0)
        if s < records[i, S_MAX]:
            e = wp.exp(-s)
        return e

    return canonical, faded


@wp.struct
class Pixel:
    """What a pixel has summed up so far: the light that still passes, colour, sum of w z, sum of w, and the splats it picks."""

    t: float
    colour: wp.vec3
    z: float
    weights: float
    median: float
    most: float
    who: float


@cache
def pixel_layers(wanted: Wanted):
    """A pixel's begin, the laying of a splat behind what it has, and the writing of its planes."""

    @wp.func
    def begin(channels: int, planes: wp.array3d[float], px: int, py: int):
        if wp.static(wanted.channels):  # any number of them: kept in the planes, where neighbours' lie side by side
            for c in range(channels):
                planes[wp.static(wanted.first_channel) + c, py, px] = 0.0
        p = Pixel()
        p.t = 1.0
        p.who = -1.0
        return p

    @wp.func
    def lay(
        p: Pixel, i: int, a: float, records: wp.array2d[float], features: wp.array2d[float], channels: int,
        planes: wp.array3d[float], px: int, py: int,
    ):  # fmt: skip
        w = p.t * a
        p.colour += w * wp.vec3(records[i, RED], records[i, GREEN], records[i, BLUE])
        if wp.static(wanted.depth):
            p.z += w * records[i, Z]
            p.weights += w
        if wp.static(wanted.channels):
            for c in range(channels):
                k = wp.static(wanted.first_channel) + c
                planes[k, py, px] = planes[k, py, px] + w * features[i, c]
        if wp.static(wanted.median):  # noqa: SIM102 - a static branch and a dynamic one
            if p.t >= 0.5 and p.t - w < 0.5:
                p.median = records[i, Z]
        if wp.static(wanted.instance):  # noqa: SIM102 - a static branch and a dynamic one
            if w > p.most:
                p.most = w
                p.who = records[i, INSTANCE]
        p.t -= w
        return p

    @wp.func
    def write(p: Pixel, planes: wp.array3d[float], picks: wp.array3d[float], px: int, py: int):
        planes[0, py, px] = p.t
        planes[1, py, px] = p.colour[0]
        planes[2, py, px] = p.colour[1]
        planes[3, py, px] = p.colour[2]
        if wp.static(wanted.depth):
            planes[4, py, px] = p.z
            planes[5, py, px] = p.weights
        if wp.static(wanted.median):
            picks[MEDIAN, py, px] = p.median
        if wp.static(wanted.instance):
            picks[WHO, py, px] = p.who

    return begin, lay, write


@wp.struct
class Behind:
    """Of a pixel in backward: the light in front of the last splat that was taken off, and dL/dT of all that lies behind it, times T; then
    that splat's weight and d loss / d alpha times its exp(-s)."""

    t: float
    rest: float
    w: float
    de: float


@cache
def pixel_unlayering(wanted: Wanted):
    """The function that takes the pixel's last splat off, back to front."""

    @wp.func
    def take_off(
        b: Behind, i: int, e: float, alpha_max: float, records: wp.array2d[float], features: wp.array2d[float], channels: int,
        grads: wp.array3d[float], px: int, py: int,
    ):  # fmt: skip
        """e: its exp(-s). With d_i = c_i . g and rest_i the sum over j behind i of w_j d_j: dL/da_i = T_i d_i - rest_i / (1 - a_i)."""
        full = records[i, OPACITY] * e
        a = wp.min(full, alpha_max)
        inverse = 1.0 / (1.0 - a)
        b.t = b.t * inverse
        b.w = b.t * a
        d = grads[1, py, px] * records[i, RED] + grads[2, py, px] * records[i, GREEN] + grads[3, py, px] * records[i, BLUE]
        if wp.static(wanted.channels):
            for c in range(channels):
                d += grads[wp.static(wanted.first_channel) + c, py, px] * features[i, c]
        if wp.static(wanted.depth):
            d += grads[4, py, px] * records[i, Z] + grads[5, py, px]
        b.de = wp.where(full < alpha_max, (b.t * d - b.rest * inverse) * e, 0.0)
        b.rest += b.w * d
        return b

    return take_off


@cache
def gradient_sums(wanted: Wanted, ray: bool, eyes: bool):
    """The function with which a block sums an entry's gradient over its pixels, and its first thread writes it to the entry's slot: no
    atomics, so the same bits every time. All threads of the block must call it, whether or not their pixel saw the splat."""
    canonical, _ = pixel_functions(ray, eyes)

    @wp.func
    def add_up(
        i: int, slot: int, thread: int, x: float, y: float, px: int, py: int, w: float, de: float,
        records: wp.array2d[float], frames: wp.array2d[wp.float64], rays: wp.array4d[wp.float64], channels: int, grads: wp.array3d[float],
        slots: wp.array2d[float], channel_slots: wp.array2d[float], frame_slots: wp.array2d[float], g_rays: wp.array4d[wp.float64],
    ):  # fmt: skip
        """w: the splat's weight at this pixel; de: d loss / d alpha times exp(-s), 0 where alpha is clamped."""
        ds = -records[i, OPACITY] * de
        sums = vec_gradients()
        sums[G_OPACITY] = de
        sums[G_RED] = w * grads[1, py, px]
        sums[G_GREEN] = w * grads[2, py, px]
        sums[G_BLUE] = w * grads[3, py, px]
        if wp.static(wanted.depth):
            sums[G_Z] = w * grads[4, py, px]
        if wp.static(ray):
            # s is least at t, so dt changes nothing: ds/dq = m, ds/du = -t m, with q = A (p - o), u = A d
            u, q = canonical(frames, rays, i, x, y)
            t = wp.dot(u, q) / wp.max(wp.dot(u, u), LEAST)
            m = wp.float64(ds) * (q - t * u)
            pushed = wp.transpose(frame_of(frames, i)) * m
            group = int(0)
            missed = wp.vec3d(frames[i, CENTRE], frames[i, CENTRE + 1], frames[i, CENTRE + 2])
            if wp.static(eyes):
                group = int(frames[i, GROUP])
                missed = missed - ray_at(rays, group, 3, x, y)
            missed = missed - t * ray_at(rays, group, 0, x, y)
            row = int(y)
            column = int(x)
            of_frame = vec_frame()
            for c in range(3):
                for r in range(3):
                    of_frame[3 * r + c] = m[r] * missed[c]
                of_frame[CENTRE + c] = pushed[c]
                if ds != 0.0 and row < rays.shape[2] and column < rays.shape[3]:  # a pixel's rays are its thread's alone
                    g_rays[group, c, row, column] = g_rays[group, c, row, column] - t * pushed[c]
                    if wp.static(eyes):
                        g_rays[group, 3 + c, row, column] = g_rays[group, 3 + c, row, column] - pushed[c]
            frame_total = wp.tile_sum(wp.tile(of_frame, preserve_type=True))[0]
            if thread == 0:
                for c in range(wp.static(FRAME_GRADIENTS)):
                    frame_slots[slot, c] = float(frame_total[c])
        else:
            k = records[i, K]
            m = records[i, M]
            h = records[i, H]
            offset, dy = from_ridge(records, i, x, y)
            sums[G_X] = -2.0 * k * k * offset * ds
            sums[G_Y] = (2.0 * k * k * m * offset - 2.0 * h * dy) * ds
            sums[G_K] = 2.0 * k * offset * offset * ds
            sums[G_M] = -2.0 * k * k * offset * dy * ds
            sums[G_H] = dy * dy * ds
        # reading a tile's sum is a barrier of the whole block: it must not stand where only some threads come by
        total = wp.tile_sum(wp.tile(sums, preserve_type=True))[0]
        if thread == 0:
            for c in range(wp.static(GRADIENTS)):
                slots[slot, c] = total[c]
        if wp.static(wanted.channels):
            for c in range(channels):
                of_channel = wp.tile_sum(wp.tile(w * grads[wp.static(wanted.first_channel) + c, py, px]))[0]
                if thread == 0:
                    channel_slots[slot, c] = of_channel

    return add_up
