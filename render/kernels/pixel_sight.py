"""What one pixel sees of a splat, for CUDA, where a thread is a pixel: as `ray_rows.py` has it for a row.

A warp's threads are a patch of 8 x 4 pixels, so that few warps have to do with a small splat. A tile's size is a parameter of all that is
made here and in `composite_cuda.py`, `composite_cuda_order.py`: with tiles of one pixel and blocks of one thread the same kernels run on
the CPU, where the tests hold them against the lane kernels and the oracle.
"""

from functools import cache

import warp as wp

from render.kernels.canonical import GROUP, MOVED
from render.kernels.ray_rows import LEAST
from render.kernels.types import (
    ALONG,
    BLUE,
    DOWN,
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
from render.kernels.warps import LANES, vec_record

OPTIONS = {"enable_backward": False}
NONE = wp.constant(wp.float64(0.0))
FRAME_GRADIENTS = 12
"""Of A row major and p."""
EDGE = wp.constant(0.05)  # pixels: a patch is widened by this, so that rounding never drops a pixel that the exponent admits


def warp_of(tile_size: int) -> tuple[int, int, int]:
    """Threads of a warp, and columns and rows of its patch of a tile."""
    return (LANES, 8, 4) if tile_size > 1 else (1, 1, 1)


@cache
def pixel_of(tile_size: int):
    """The function that says where a thread's pixel lies: column and row in its window, and its centre in the image."""
    lanes, wide, high = warp_of(tile_size)

    @wp.func
    def pixel(window: Window, tile: int, thread: int):
        warp = thread // wp.static(lanes)
        lane = thread % wp.static(lanes)
        across = wp.static(tile_size // wide)  # patches
        px = (tile % window.tiles_x) * wp.static(tile_size) + warp % across * wp.static(wide) + lane % wp.static(wide)
        py = (tile // window.tiles_x) * wp.static(tile_size) + warp // across * wp.static(high) + lane // wp.static(wide)
        x = float(window.left * wp.static(tile_size) + px) + 0.5
        y = float(window.top * wp.static(tile_size) + py) + 0.5
        return px, py, x, y

    return pixel


@wp.func
def from_ridge(r: vec_record, x: float, y: float):
    """dx - M dy and dy of the pixel centre x, y."""
    dy = (y - r[Y]) - r[Y_REST]
    return (x - r[X]) - r[X_REST] - r[M] * dy, dy


@cache
def patch_meets(tile_size: int):
    """The function that says whether a splat's conic, which bounds it along rays, too, reaches the patch of pixels whose first is centred
    on x, y: the least of a convex s over a rectangle, which is at its middle or on an edge."""
    _, wide, high = warp_of(tile_size)

    @wp.func
    def meets(r: vec_record, x: float, y: float):
        left = x - r[X] - EDGE
        top = y - r[Y] - EDGE
        right = left + wp.static(wide - 1.0) + 2.0 * EDGE
        bottom = top + wp.static(high - 1.0) + 2.0 * EDGE
        k2 = r[K] * r[K]
        m = r[M]
        h = r[H]
        least = float(0.0)
        if left > 0.0 or right < 0.0 or top > 0.0 or bottom < 0.0:
            above = wp.clamp(m * top, left, right) - m * top
            below = wp.clamp(m * bottom, left, right) - m * bottom
            slope = k2 * m / (k2 * m * m + h)
            dy_left = wp.clamp(slope * left, top, bottom)
            dy_right = wp.clamp(slope * right, top, bottom)
            on_left = left - m * dy_left
            on_right = right - m * dy_right
            least = wp.min(
                wp.min(k2 * above * above + h * top * top, k2 * below * below + h * bottom * bottom),
                wp.min(k2 * on_left * on_left + h * dy_left * dy_left, k2 * on_right * on_right + h * dy_right * dy_right),
            )
        return not least > r[S_MAX]  # what is no number is looked at

    return meets


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
    """How a pixel looks at splat i: `canonical`, its ray in the splat's frame, u and q, `faded`, exp(-s) within the cutoff and 0 beyond it,
    by the conic or along the ray, and `depth`. eyes: as of `ray_functions`."""

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
    def faded(r: vec_record, frames: wp.array2d[wp.float64], rays: wp.array4d[wp.float64], i: int, x: float, y: float):
        s = float(0.0)
        if wp.static(ray):
            u, q = canonical(frames, rays, i, x, y)
            along = wp.dot(u, q)
            m = q - (along / wp.max(wp.dot(u, u), LEAST)) * u
            s = float(wp.dot(m, m) * wp.float64(0.5))
            # neither behind the ray's begin, nor on the other side of an image that closes on itself
            if not (along > NONE and wp.abs(x - r[X]) < r[X_REST]):
                s = r[S_MAX]
        else:
            offset, dy = from_ridge(r, x, y)
            u = offset * r[K]
            s = u * u + r[H] * dy * dy
        e = float(0.0)
        if s < r[S_MAX]:
            e = wp.exp(-s)
        return e

    @wp.func
    def depth(
        r: vec_record, slopes: wp.array[wp.vec2], frames: wp.array2d[wp.float64], rays: wp.array4d[wp.float64], i: int, x: float, y: float
    ):
        """Where the pixel meets the splat."""
        if wp.static(ray):
            u, q = canonical(frames, rays, i, x, y)
            return float(wp.dot(u, q) / wp.max(wp.dot(u, u), LEAST))
        return r[Z] + slopes[i][ALONG] * (x - r[X]) + slopes[i][DOWN] * (y - r[Y])

    return canonical, faded, depth


@wp.struct
class Pixel:
    """What a pixel has summed up so far: the light that still passes, colour, sum of w z, sum of w, and what it picks."""

    t: float
    colour: wp.vec3
    z: float
    weights: float
    median: float
    lead: float
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
        p: Pixel, r: vec_record, i: int, a: float, far: float, features: wp.array2d[float], channels: int,
        planes: wp.array3d[float], px: int, py: int,
    ):  # fmt: skip
        """far: its depth, where that is wanted."""
        w = p.t * a
        p.colour += w * wp.vec3(r[RED], r[GREEN], r[BLUE])
        if wp.static(wanted.depth):
            p.z += w * far
            p.weights += w
        if wp.static(wanted.channels):
            for c in range(channels):
                k = wp.static(wanted.first_channel) + c
                planes[k, py, px] = planes[k, py, px] + w * features[i, c]
        if wp.static(wanted.median):  # noqa: SIM102 - a static branch and a dynamic one
            if p.t >= 0.5 and p.t - w < 0.5:
                p.median = far
        if wp.static(wanted.instance):
            p.lead += wp.where(p.who == r[INSTANCE], w, -w)
            if p.lead < 0.0:
                p.lead = -p.lead
                p.who = r[INSTANCE]
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
    that splat's weight and d loss / d alpha times its exp(-s). g, g_z, g_weights: dL/d colour, sum of w z, sum of w."""

    t: float
    rest: float
    w: float
    de: float
    g: wp.vec3
    g_z: float
    g_weights: float


@cache
def pixel_unlayering(wanted: Wanted):
    """The pixel's state when nothing is taken off yet, and the function that takes its last splat off, back to front."""

    @wp.func
    def behind(planes: wp.array3d[float], grads: wp.array3d[float], px: int, py: int):
        b = Behind()
        b.t = planes[0, py, px]
        b.rest = grads[0, py, px]
        b.g = wp.vec3(grads[1, py, px], grads[2, py, px], grads[3, py, px])
        if wp.static(wanted.depth):
            b.g_z = grads[4, py, px]
            b.g_weights = grads[5, py, px]
        return b

    @wp.func
    def take_off(
        b: Behind, r: vec_record, i: int, e: float, alpha_max: float, far: float, features: wp.array2d[float], channels: int,
        grads: wp.array3d[float], px: int, py: int,
    ):  # fmt: skip
        """e: its exp(-s); far: its depth, where that is wanted. With d_i = c_i . g and rest_i the sum over j behind i of w_j d_j:
        dL/da_i = T_i d_i - rest_i / (1 - a_i)."""
        full = r[OPACITY] * e
        a = wp.min(full, alpha_max)
        inverse = 1.0 / (1.0 - a)
        b.t = b.t * inverse
        b.w = b.t * a
        d = b.g[0] * r[RED] + b.g[1] * r[GREEN] + b.g[2] * r[BLUE]
        if wp.static(wanted.channels):
            for c in range(channels):
                d += grads[wp.static(wanted.first_channel) + c, py, px] * features[i, c]
        if wp.static(wanted.depth):
            d += b.g_z * far + b.g_weights
        b.de = wp.where(full < alpha_max, (b.t * d - b.rest * inverse) * e, 0.0)
        b.rest += b.w * d
        return b

    return behind, take_off
