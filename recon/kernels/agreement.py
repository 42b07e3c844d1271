"""What another photo shows where a picture's points stand in it, and how that changes with their depth."""

from functools import cache

import warp as wp

from render.kernels.lenses import LensFunctions
from render.kernels.lenses.optics import Optics
from render.kernels.types import OPTIONS, pixel_of, pixels_of

wp.set_module_options(OPTIONS)


@wp.struct
class Picture:
    """A picture `[H, W]`: rays of depth 1 through its pixels, what is drawn there, and the photo of it."""

    rays: wp.array2d[wp.vec3]
    depth: wp.array2d[float]
    alpha: wp.array2d[float]
    instance: wp.array2d[int]
    photo: wp.array2d[wp.vec3]


@wp.struct
class Readouts:
    """ways `[2, 2]`: from a picture's camera as its readout begins, and as it ends, to another one as its own begins (the first index), and
    as it ends; both read rows, or columns, one after the other."""

    ways: wp.array2d[wp.mat44d]
    by_columns: int


PART = wp.constant(wp.float64(0.01))  # of a depth, over which it is found how what a photo shows changes with it
ZERO, ONE = wp.constant(wp.float64(0.0)), wp.constant(wp.float64(1.0))


@wp.func
def carried(readouts: Readouts, its: int, share: wp.float64, p: wp.vec3d):
    """Where a point that a picture shows at a share of its readout stands for the other camera as its own begins (0) or ends (1)."""
    return wp.lerp(wp.transform_point(readouts.ways[its, 0], p), wp.transform_point(readouts.ways[its, 1], p), share)


@wp.func
def mean_size(v: wp.vec3):
    return (wp.abs(v[0]) + wp.abs(v[1]) + wp.abs(v[2])) / 3.0


@cache
def look_kernel(lens: LensFunctions) -> wp.Kernel:
    """For other photos that were taken through a lens."""
    pixel = lens.pixel

    @wp.func
    def sees(optics: Optics, v: wp.vec3d):
        return v[2] > optics.cos_limit * wp.length(v)

    @wp.kernel(module="unique", module_options=OPTIONS, enable_backward=False)
    def look(
        picture: Picture, readouts: Readouts, solid: float, optics: Optics, photo: wp.array2d[wp.vec3],
        step: int, top: int, left: int, found: wp.array3d[float], slopes: wp.array2d[float],
        stretch: int, first: int,
    ):  # fmt: skip
        """photo: the other camera's, as large. found `[3, h, w]`, at every `step`th row and column from `top` and `left` on: by how much
        the picture's own photo differs, in the mean over colours, from what the other one shows of a pixel of the street whose alpha is at
        least `solid`, bilinear; from what that shows at the same place; and 1 where both are known, else all 0. slopes: how the first
        changes with the logarithm of the pixel's depth."""
        begin, end = pixels_of(first + wp.tid(), stretch, slopes.shape[0], slopes.shape[1])
        for item in range(begin, end):
            y, x = pixel_of(item, slopes.shape[1])
            row = top + step * y
            column = left + step * x
            off = wp.vec3(wp.nan, wp.nan, wp.nan)
            change = wp.vec3()
            depth = picture.depth[row, column]
            if picture.instance[row, column] == 0 and picture.alpha[row, column] >= solid and wp.isfinite(depth):
                # lines are read one after the other: rows, or columns
                axis = int(1)
                at = float(row)
                lines = float(photo.shape[0])
                if readouts.by_columns != 0:
                    axis = 0
                    at = float(column)
                    lines = float(photo.shape[1])
                mine = wp.float64((at + 0.5) / lines)
                p = wp.vec3d(picture.rays[row, column]) * wp.float64(depth)
                v0 = carried(readouts, 0, mine, p)
                v1 = carried(readouts, 1, mine, p)
                share = wp.float64(0.5)
                v = wp.lerp(v0, v1, share)
                # when it is read out there: of a point that moves by a tenth of the picture meanwhile a thousandth is left
                for _k in range(2):
                    if sees(optics, v):
                        share = wp.clamp(pixel(optics, v)[axis] / wp.float64(lines), ZERO, ONE)
                        v = wp.lerp(v0, v1, share)
                if sees(optics, v):
                    eye = wp.lerp(carried(readouts, 0, mine, wp.vec3d()), carried(readouts, 1, mine, wp.vec3d()), share)
                    deeper = v + PART * (v - eye)
                    if sees(optics, deeper):
                        here = pixel(optics, v)
                        move = (pixel(optics, deeper) - here) / PART
                        across = float(here[0]) - 0.5
                        down = float(here[1]) - 0.5
                        # so that what is no number is outside
                        if across >= 0.0 and down >= 0.0 and across < float(photo.shape[1] - 1) and down < float(photo.shape[0] - 1):
                            u = int(across)
                            w = int(down)
                            s = across - float(u)
                            t = down - float(w)
                            corner = photo[w, u]
                            above = photo[w, u + 1] - corner
                            beside = photo[w + 1, u] - corner
                            bend = photo[w + 1, u + 1] - photo[w + 1, u] - above
                            off = corner + s * above + t * beside + (s * t) * bend - picture.photo[row, column]
                            change = float(move[0]) * (above + t * bend) + float(move[1]) * (beside + s * bend)
            still = photo[row, column] - picture.photo[row, column]
            known = wp.isfinite(off[0]) and wp.isfinite(still[0])  # the recording car's colours are no numbers
            found[0, y, x] = wp.where(known, mean_size(off), 0.0)
            found[1, y, x] = wp.where(known, mean_size(still), 0.0)
            found[2, y, x] = wp.where(known, 1.0, 0.0)
            rise = (wp.sign(off[0]) * change[0] + wp.sign(off[1]) * change[1] + wp.sign(off[2]) * change[2]) / 3.0
            slopes[y, x] = wp.where(known, rise, 0.0)

    return look
