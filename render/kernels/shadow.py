"""The light that a shadow leaves to what each pixel of a window shows."""

import warp as wp

from render.kernels.types import OPTIONS, pixel_of

wp.set_module_options(OPTIONS)


@wp.struct
class Falling:
    """A shadow in the frame of the asset that casts it: its instance id, whether the camera's shutter moves along columns, half the asset's
    length and width, the metres of height up to which a surface is the ground and up to which the asset itself receives some, and the box
    whose light is known."""

    instance: int
    by_columns: int
    half: wp.vec2
    ground: float
    skirt: float
    low: wp.vec3
    high: wp.vec3


@wp.func
def share(blocked: wp.array3d[float], at: wp.vec3):
    """What is blocked at grid coordinates `at`: trilinear, 0 beyond the grid."""
    x0 = int(wp.floor(at[0]))
    y0 = int(wp.floor(at[1]))
    z0 = int(wp.floor(at[2]))
    total = float(0.0)
    for k in range(8):
        x = x0 + (k & 1)
        y = y0 + ((k >> 1) & 1)
        z = z0 + (k >> 2)
        if x >= 0 and y >= 0 and z >= 0 and x < blocked.shape[2] and y < blocked.shape[1] and z < blocked.shape[0]:
            near = (1.0 - wp.abs(at[0] - float(x))) * (1.0 - wp.abs(at[1] - float(y))) * (1.0 - wp.abs(at[2] - float(z)))
            total += near * blocked[z, y, x]
    return total


@wp.kernel
def fall(
    shadow: Falling, poses: wp.array[wp.mat44], blocked: wp.array3d[float],
    rays: wp.array2d[wp.vec3], origins: wp.array2d[wp.vec3], depth: wp.array2d[float], instance: wp.array2d[int],
    own: wp.array2d[float], left: int, top: int, light: wp.array2d[float],
    first: int,
):  # fmt: skip
    """poses: the camera's in the asset's frame, one or one for each row or column. origins: where rays begin, one or one for each pixel.
    own: the part of what a pixel shows that is the asset itself. light: of a window whose first pixel is at left, top; 1 where no shadow
    falls."""
    v, u = pixel_of(first + wp.tid(), light.shape[1])
    row = top + v
    column = left + u
    light[v, u] = 1.0
    z = depth[row, column]
    if z == wp.inf:
        return
    line = int(0)
    if poses.shape[0] > 1:
        line = wp.where(shadow.by_columns != 0, column, row)
    eye = wp.transform_point(poses[line], origins[wp.min(row, origins.shape[0] - 1), wp.min(column, origins.shape[1] - 1)])
    ray = wp.transform_vector(poses[line], rays[row, column])
    if eye[2] <= 0.0:
        return  # the ground is seen from below
    point = eye + z * ray
    height = point[2]
    # within the footprint the depth mixes the asset with the ground that shows through it
    inside = wp.abs(point[0]) < shadow.half[0] and wp.abs(point[1]) < shadow.half[1] and height > 0.1
    if inside or instance[row, column] == shadow.instance or height < shadow.ground:
        # rays that rise never meet the plane: their point lies far off, where no shadow is
        point = eye - (eye[2] / wp.min(ray[2], -1.0e-6)) * ray
    sides = shadow.high - shadow.low
    at = wp.cw_div(point - shadow.low, sides)
    at = wp.vec3(at[0] * float(blocked.shape[2] - 1), at[1] * float(blocked.shape[1] - 1), wp.max(at[2], 0.0) * float(blocked.shape[0] - 1))
    if not (at[0] > -1.0 and at[0] < float(blocked.shape[2]) and at[1] > -1.0 and at[1] < float(blocked.shape[1])):
        return
    if not at[2] < float(blocked.shape[0]):
        return
    # at its rim the asset lets the ground through, on which the shadow lies as beside it
    s = wp.clamp(1.0 - height / shadow.skirt, 0.0, 1.0)
    receives = 1.0 - own[row, column] * (1.0 - s * s * (3.0 - 2.0 * s))
    light[v, u] = 1.0 - receives * share(blocked, at)
