"""Shared by all kernels: the tile, lane vectors, uniforms, and the layout of a projected splat."""

from typing import NamedTuple

import warp as wp

# Warp's default limits SLP vectorisation to depth four, which costs 1.6x on the composite kernels; without SLP it is 3x.
OPTIONS = {
    "enable_backward": False,
    "cpu_compiler_flags": "-march=native -mllvm=-inline-threshold=9000 -mprefer-vector-width=512 -ffp-contract=fast",
}

TILE = 16
lanes = wp.types.vector(length=TILE, dtype=wp.float32)

RECORD = 16
"""Floats of a projected splat: one cache line. With dx, dy the pixel's offset from (X, Y), the exponent is
s = (K (dx - M dy))^2 + H dy^2: the conic as a product of conditionals, which does not cancel for needles as
a dx^2 + 2 b dx dy + c dy^2 does, and gives a row's exact extent by one square root. A centre is kept in two parts, since a float has
0.0001 pixels at 2,000: X is what a float holds of it, X_REST what that leaves over. X - x0 is exact. With response "ray" the conic only
bounds a splat, and X_REST is how far from X it may be seen: half a turn, of a lens whose image closes on itself."""
X, Y, K, M, H, OPACITY, S_MAX, RED, GREEN, BLUE, Z, INSTANCE, Y_EXT, Y_AT_EXT, X_REST, Y_REST = (wp.constant(i) for i in range(RECORD))
# Y_EXT: the ellipse's reach in y; Y_AT_EXT: dy of its rightmost point

ALONG, DOWN = wp.constant(0), wp.constant(1)
"""A projected splat's slopes, beside its record: what its depth grows by from Z at (X, Y) on, a pixel to the right and down. So it is, to
first order, where a ray meets the splat (Zhang et al. 2024, "RaDe-GS"): the mean of depth that the projected 3D Gaussian has at the pixel.
With response "ray" it is where the ray itself does, and there are none."""

GRADIENTS = 12
"""Floats of a gradient slot, one slot an intersection: d loss / d (X, Y, K, M, H, OPACITY, RED, GREEN, BLUE, Z), then of the
slopes."""
G_X, G_Y, G_K, G_M, G_H, G_OPACITY, G_RED, G_GREEN, G_BLUE, G_Z, G_ALONG, G_DOWN = (wp.constant(i) for i in range(GRADIENTS))


class Wanted(NamedTuple):
    """What a composite kernel sums up. One is compiled for every combination that is asked for.

    Its planes: T, red, green, blue[, sum of w z, sum of w][, channels ...]; beside them, without gradients, MEDIAN and WHO.
    """

    depth: bool = False
    median: bool = False
    instance: bool = False
    channels: bool = False

    @property
    def first_channel(self) -> int:
        return 6 if self.depth else 4

    @property
    def depths(self) -> bool:
        return self.depth or self.median

    @property
    def picks(self) -> bool:
        return self.median or self.instance


MEDIAN, WHO = 0, 1
"""Planes that pick one for each pixel: the depth of the splat behind which less than half the light passes, the id of the instance whose
splats weigh most together. This is found by a vote that takes two numbers however many instances there are (Boyer and Moore 1981, MJRTY,
weighted): one is held with its lead; its own splats add their weight to that, all others take it away, and who takes away more than there
is, is held. So whoever weighs more than all others together is held at the end, and of two always the heavier."""

ITEM = 64
"""Splats of an item of projection's work at most; their pose gradient is summed before it is written."""

FIRST, COUNT, BASE, DRAW = (wp.constant(i) for i in range(4))
"""Of an item: its first splat, how many, the first one's record, and the row of poses that it has."""

UNIFORM_GRADIENTS = 16
"""Floats of the gradient shared by all splats of an instance: rotation (row major), translation, fx, fy, cx, cy."""

SLACK = wp.constant(0.01)  # px: extents are widened by this, so that rounding never drops a pixel that the exponent admits
ROOT3 = wp.constant(wp.float64(1.7320508075688772))
HALF, ONE, TWO = (wp.constant(wp.float64(number)) for number in (0.5, 1.0, 2.0))
REACH = wp.constant(3.33)  # sigma at which the most opaque splat has faded to 1/255
FARTHEST = wp.constant(1.0e12)  # metres from the camera beyond which a splat is not drawn: squares of squares must stay floats
CULLED = wp.constant(2147483647)
TINY, LEAST = wp.constant(1.0e-30), wp.constant(wp.float64(1.0e-30))  # what a length or a variance is divided by at least


@wp.struct
class Window:
    """Part of the image that is drawn at once, in tiles."""

    left: int
    top: int
    tiles_x: int
    tiles_y: int


@wp.struct
class View:
    """A camera and how to draw: everything that is the same for all splats."""

    lens: wp.vec4d  # fx, fy, cx, cy
    left: float  # the sides of the view, as x/z and y/z, widened by the dilation's reach
    right: float
    top: float
    bottom: float
    clamp_left: wp.float64  # the Jacobian is taken no further out than these (Kerbl et al. 2023: 1.3 tan of half the view)
    clamp_right: wp.float64
    clamp_top: wp.float64
    clamp_bottom: wp.float64
    middle: wp.vec2d  # of the view, and one over half of it, as these
    per_half: wp.vec2d
    tile_left: int  # the tiles that are drawn
    tile_top: int
    tiles_x: int
    tiles_y: int
    dilation: float  # px^2 added to both variances
    smoothing: float  # of the dilation, what opacities make up for
    along_rays: int  # whether records only bound a splat (`ray_bound.py`)
    near: float
    log_cutoff: float  # ln(1 / alpha cutoff)
    cutoff: float  # splats up to this opacity are not drawn
    unscented: int


@wp.struct
class Pose:
    """cam_from_local of one instance, and the eye in its local frame. Splats are carried over in float64: in float32 the far end of a
    needle would miss, in parts of its width, by 6e-8 times its length over its width."""

    rotation: wp.mat33d
    translation: wp.vec3d
    eye: wp.vec3
    instance: float


@wp.func
def pixel_of(item: int, width: int):
    """Row and column of a picture's item-th pixel."""
    row = item // width
    return row, item - row * width


@wp.func
def pixels_of(item: int, stretch: int, height: int, width: int):
    """Of the pixels that an item does, `stretch` in a row, the first, and the one behind the last."""
    begin = stretch * item
    return begin, wp.min(begin + stretch, height * width)


@wp.func
def matrix_at(rows: wp.array2d[wp.float64], d: int, at: int):
    return wp.mat33d(
        rows[d, at], rows[d, at + 1], rows[d, at + 2],
        rows[d, at + 3], rows[d, at + 4], rows[d, at + 5],
        rows[d, at + 6], rows[d, at + 7], rows[d, at + 8],
    )  # fmt: skip


@wp.func
def vector_at(rows: wp.array2d[wp.float64], d: int, at: int):
    return wp.vec3d(rows[d, at], rows[d, at + 1], rows[d, at + 2])


@wp.func
def pose_of(rows: wp.array2d[wp.float64], d: int):
    """Row d: rotation (row major), translation, eye, instance."""
    p = Pose()
    p.rotation = matrix_at(rows, d, 0)
    p.translation = vector_at(rows, d, 9)
    p.eye = wp.vec3(vector_at(rows, d, 12))
    p.instance = float(rows[d, 15])
    return p
