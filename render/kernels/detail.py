"""What other views know of a picture's pixels: looked up where a pixel's point stands there, if that view shows the same surface."""

import warp as wp

from render.kernels.flow import shows
from render.kernels.types import OPTIONS, pixel_of, pixels_of

wp.set_module_options(OPTIONS)

SHARPNESS = wp.constant(-0.75)  # of the cubic: as torch's and OpenCV's
RIM = wp.constant(1.0 / 16.0)  # of a photo's longer side: so far from its border its sky fades, which else would end in an edge


@wp.struct
class Other:
    """Another view: its detail, depth, inf at the sky, and instances, `[h, w]` each."""

    detail: wp.array2d[wp.vec4]
    depth: wp.array2d[float]
    instance: wp.array2d[int]


@wp.struct
class Here:
    """The picture's pixels `[H, W]`: where they stand in the other view and at what depth, their instances, and which may be looked up."""

    pixels: wp.array2d[wp.vec2d]
    depths: wp.array2d[float]
    instance: wp.array2d[int]
    clear: wp.array2d[wp.bool]


@wp.func
def cubic(t: float):
    """Weights of four neighbours, t from the second to the third (Keys 1981)."""
    u = 1.0 - t
    a = SHARPNESS
    return wp.vec4(
        a * t * u * u,
        ((a + 2.0) * t - (a + 3.0)) * t * t + 1.0,
        ((a + 2.0) * u - (a + 3.0)) * u * u + 1.0,
        a * u * t * t,
    )


@wp.func
def looked_up(other: Other, here: Here, row: int, column: int, hides: float):
    """The detail there, and in w whether the pixel is known there: 1 or 0; else 0 0 0 0, 0."""
    height = other.depth.shape[0]
    width = other.depth.shape[1]
    at = here.pixels[row, column]
    known = float(0.0)
    found = wp.vec4(0.0)
    if here.clear[row, column] and shows(at, here.depths[row, column], hides, other.depth):
        u = wp.clamp(int(wp.floor(at[0])), 0, width - 1)
        v = wp.clamp(int(wp.floor(at[1])), 0, height - 1)
        if other.instance[v, u] == here.instance[row, column]:
            known = 1.0
            x = float(at[0]) - 0.5
            y = float(at[1]) - 0.5
            x0 = int(wp.floor(x))
            y0 = int(wp.floor(y))
            across = cubic(x - float(x0))
            down = cubic(y - float(y0))
            for j in range(4):
                r = wp.clamp(y0 + j - 1, 0, height - 1)
                line = wp.vec4(0.0)
                for i in range(4):
                    line += across[i] * other.detail[r, wp.clamp(x0 + i - 1, 0, width - 1)]
                found += down[j] * line
    return found, known


@wp.func
def from_border(other: Other, at: wp.vec2d):
    """0 at another view's border, and 1 farther from it than its rim."""
    height = float(other.depth.shape[0])
    width = float(other.depth.shape[1])
    across = wp.min(float(at[0]), width - float(at[0]))
    down = wp.min(float(at[1]), height - float(at[1]))
    return wp.smoothstep(0.0, RIM * wp.max(width, height), wp.min(across, down))


@wp.kernel
def carry_over(other: Other, here: Here, hides: float, keep: float, detail: wp.array2d[wp.vec4], stretch: int, first: int):
    """Of the detail of the view before, `keep` is kept, where it is known."""
    begin, end = pixels_of(first + wp.tid(), stretch, detail.shape[0], detail.shape[1])
    for item in range(begin, end):
        row, column = pixel_of(item, detail.shape[1])
        found, known = looked_up(other, here, row, column, hides)
        if known > 0.0:
            detail[row, column] = wp.lerp(detail[row, column], found, keep)


@wp.kernel
def add_photo(
    other: Other, here: Here, hides: float, share: float, noise: float, parallax: float, rays: wp.array2d[wp.vec3],
    depth: wp.array2d[float], sums: wp.array2d[wp.vec4], squares: wp.array2d[float],
    stretch: int, first: int,
):  # fmt: skip
    """A photo's detail, by how sure it is: sums of that, with the sum of the weights in w, and of its mean square. parallax: what it
    adds to the noise, times the distance."""
    begin, end = pixels_of(first + wp.tid(), stretch, depth.shape[0], depth.shape[1])
    for item in range(begin, end):
        row, column = pixel_of(item, depth.shape[1])
        found, known = looked_up(other, here, row, column, hides)
        if known > 0.0:
            sure = share / noise
            if here.instance[row, column] >= 0:
                sure = share / (noise + parallax / (depth[row, column] * wp.length(rays[row, column])))
            else:
                sure *= from_border(other, here.pixels[row, column])
            sums[row, column] = sums[row, column] + sure * wp.vec4(found[0], found[1], found[2], 1.0)
            square = (found[0] * found[0] + found[1] * found[1] + found[2] * found[2]) / 3.0
            squares[row, column] = squares[row, column] + sure * square
