"""Rays against triangle meshes: what they meet first, and whether they meet anything."""

import warp as wp

PAST = wp.constant(1.0e-4)  # metres beyond a hit that was let pass, from where the ray goes on
LAYERS = wp.constant(32)  # see-through surfaces that one ray may pass


@wp.struct
class Surface:
    """Corners of F triangles: normals `[3 F]`, texture coordinates `[3 F]` (v downwards, in textures), tints rgba `[3 F]`; their textures
    `[F]`, and of each of those `[M]` the first texel, width and height in one list of texels rgba, display-referred as the tints."""

    normals: wp.array[wp.vec3]
    uvs: wp.array[wp.vec2]
    tints: wp.array[wp.vec4]
    texture: wp.array[wp.int32]
    first: wp.array[wp.int32]
    width: wp.array[wp.int32]
    height: wp.array[wp.int32]
    texels: wp.array[wp.vec4]


@wp.func
def texel(s: Surface, m: int, column: int, row: int):
    """Texel of texture m; textures repeat."""
    w = s.width[m]
    h = s.height[m]
    x = ((column % w) + w) % w
    y = ((row % h) + h) % h
    return s.texels[s.first[m] + y * w + x]


@wp.func
def sample(s: Surface, m: int, uv: wp.vec2):
    """Bilinear lookup of texture m."""
    x = uv[0] * float(s.width[m]) - 0.5
    y = uv[1] * float(s.height[m]) - 0.5
    column = int(wp.floor(x))
    row = int(wp.floor(y))
    fx = x - wp.floor(x)
    fy = y - wp.floor(y)
    upper = texel(s, m, column, row) * (1.0 - fx) + texel(s, m, column + 1, row) * fx
    lower = texel(s, m, column, row + 1) * (1.0 - fx) + texel(s, m, column + 1, row + 1) * fx
    return upper * (1.0 - fy) + lower * fy


@wp.kernel
def trace_surface(
    mesh: wp.uint64,
    surface: Surface,
    opaque_from: float,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    colours: wp.array[wp.vec4],
    normals: wp.array[wp.vec3],
    distances: wp.array[float],
    first: int,
):
    """Colour (alpha 1, or 0 0 0 0 for a miss), normal towards the viewer and distance of the first texel of enough alpha along each ray."""
    i = first + wp.tid()
    origin = origins[i]
    direction = wp.normalize(directions[i])
    far = float(0.0)
    colours[i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
    normals[i] = wp.vec3(0.0, 0.0, 0.0)
    distances[i] = wp.inf
    for _layer in range(LAYERS):
        hit = wp.mesh_query_ray(mesh, origin + far * direction, direction, 1.0e6)
        if not hit.result:
            return
        far += hit.t + PAST
        f = hit.face
        w = 1.0 - hit.u - hit.v
        uv = hit.u * surface.uvs[3 * f] + hit.v * surface.uvs[3 * f + 1] + w * surface.uvs[3 * f + 2]
        tint = hit.u * surface.tints[3 * f] + hit.v * surface.tints[3 * f + 1] + w * surface.tints[3 * f + 2]
        c = wp.cw_mul(sample(surface, surface.texture[f], uv), tint)
        if c[3] >= opaque_from:
            n = hit.u * surface.normals[3 * f] + hit.v * surface.normals[3 * f + 1] + w * surface.normals[3 * f + 2]
            if wp.dot(n, direction) > 0.0:
                n = -n
            colours[i] = wp.vec4(c[0], c[1], c[2], 1.0)
            normals[i] = wp.normalize(n)
            distances[i] = far - PAST
            return


@wp.kernel
def visible(
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    reach: float,
    weights: wp.array[float],
    out: wp.array[float],
    first: int,
):
    """Of each point the weight of the directions in which nothing stands within `reach`."""
    i = first + wp.tid()
    total = float(0.0)
    for k in range(directions.shape[0]):
        if weights[k] > 0.0 and not wp.mesh_query_ray_anyhit(mesh, points[i], directions[k], reach):
            total += weights[k]
    out[i] = total
