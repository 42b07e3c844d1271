"""Truth: the splat model in float64 torch, slow and obviously right, differentiable by autograd.

The model (projection, response, dilation, antialiasing, smoothing) is what a scene was trained with. Its exact picture, which `truth`
gives, sums all splats along every pixel's own ray in that ray's own order, with no cutoff, no clamp and no termination. `render` can also
take the shortcuts of the kernels one by one (order by centres, cutoff, clamp), so that each kernel is held against exactly what it
promises.

Written from the papers' matrices (Zwicker et al. 2001; Julier and Uhlmann 1997 with alpha = 1, beta = 2, kappa = 0), not from the
kernels' factored form, so that an error in that algebra shows.
"""

import math

import torch

from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.harmonics import evaluate
from scenes.lenses import Lens, Pinhole
from scenes.poses import inverse, matrix_from_quat
from tests import oracle_lens

NEAR = 0.1
REACH = 3.33
PART = 12  # pixels on a side of a part of a large picture
BEYOND = 9.0  # sigma: exp(-40) is below float64's rounding of 1
TIE = 1e-9  # of its depth: two splats nearer to each other than this on a ray may stand in either order
SEEN = 1e-5  # what such a swap must change to matter


def to_float64(g: Gaussians) -> dict[str, torch.Tensor]:
    """The fields of `g` as float64 leaves that ask for gradients."""
    return {name: t.detach().double().requires_grad_() for name, t in g.tensors().items()}


def sides(lens: torch.Tensor, width: int, height: int, margin: float):
    """Left, right, top, bottom of the image widened by a margin in pixels (x, y), as x/z and y/z."""
    fx, fy, cx, cy = lens.detach().tolist()
    mx, my = margin if isinstance(margin, tuple) else (margin, margin)
    return -(cx + mx) / fx, (width - cx + mx) / fx, -(cy + my) / fy, (height - cy + my) / fy


def clamped(points: torch.Tensor, lens: torch.Tensor, width: int, height: int) -> torch.Tensor:
    """Where the Jacobian is taken: xy / z, no further out than 1.3 times half the view."""
    left, right, top, bottom = sides(lens, width, height, (0.15 * width, 0.15 * height))
    x, y, z = points.unbind(-1)
    return torch.stack([(x / z).clamp(left, right), (y / z).clamp(top, bottom)], -1)


def in_view(points: torch.Tensor, axes: torch.Tensor, lens: torch.Tensor, width: int, height: int, dilation: float) -> torch.Tensor:
    """Mask of splats beyond the near plane whose ellipsoid of 3.33 sigma is not wholly beyond one side of the view."""
    left, right, top, bottom = sides(lens, width, height, 4 * math.sqrt(dilation) + 1)
    seen = points[:, 2] > NEAR
    for plane in ([1, 0, -right], [-1, 0, left], [0, 1, -bottom], [0, -1, top]):
        normal = torch.tensor(plane, dtype=torch.float64)
        seen &= points @ normal <= REACH * (axes.transpose(1, 2) @ normal).norm(dim=-1)
    return seen


def project_ewa(points: torch.Tensor, covariance: torch.Tensor, lens: torch.Tensor, width: int, height: int):
    fx, fy, cx, cy = lens
    x, y, z = points.unbind(-1)
    jx, jy = clamped(points, lens, width, height).unbind(-1)
    zero = torch.zeros_like(z)
    jacobian = torch.stack([torch.stack([fx / z, zero, -fx * jx / z], -1), torch.stack([zero, fy / z, -fy * jy / z], -1)], -2)
    mean = torch.stack([fx * x / z + cx, fy * y / z + cy], -1)
    return mean, jacobian @ covariance @ jacobian.transpose(-1, -2), (jacobian @ covariance)[..., 2]


def project_ut(points: torch.Tensor, axes: torch.Tensor, lens: torch.Tensor, width: int, height: int):
    """Sigma points at +-sqrt(3) along `axes` (columns, scaled); one nearer than `oracle_lens.least_depth` of the centre's lies there."""
    fx, fy, cx, cy = lens
    root = math.sqrt(3.0)
    centre = points[:, :2] / points[:, 2:]
    n = clamped(points, lens, width, height)
    nearest = oracle_lens.least_depth(n, sides(lens, width, height, 0.0)) * points[:, 2]
    sigma = []
    for sign in (root, -root):
        offset = sign * axes.transpose(1, 2)  # [N, 3 axes, 3]
        depth = torch.maximum(points[:, None, 2] + offset[..., 2], nearest[:, None])
        # the offset from the sight line n = xy / z is divided by the sigma point's own depth
        sigma.append(centre[:, None] + (offset[..., :2] - n[:, None] * offset[..., 2:]) / depth[..., None])
    pixels = torch.cat([centre[:, None], *sigma], 1) * torch.stack([fx, fy]) + torch.stack([cx, cy])  # [N, 7, 2]
    mean_weights = torch.tensor([0.0] + [1 / 6] * 6, dtype=torch.float64)
    covariance_weights = torch.tensor([2.0] + [1 / 6] * 6, dtype=torch.float64)
    mean = (mean_weights[:, None] * pixels).sum(1)
    d = pixels - mean[:, None]
    farther = torch.cat([torch.zeros_like(points[:, :1]), root * axes[:, 2], -root * axes[:, 2]], 1)  # [N, 7]
    covariance = torch.einsum("k,nki,nkj->nij", covariance_weights, d, d)
    return mean, covariance, torch.einsum("k,nki,nk->ni", covariance_weights, d, farther)


def render(
    placed: list[tuple[dict[str, torch.Tensor], torch.Tensor, int]],
    camera: Camera,
    model: SplatModel,
    world_from_cam: torch.Tensor | None = None,
    lens: torch.Tensor | None = None,
    cutoff: float = 0.0,
    alpha_max: float = 1.0,
    order: str = "tile",
    jumps: bool = False,
    world_from_cam_end: torch.Tensor | None = None,
    ends: list[torch.Tensor | None] | None = None,
    features: bool = False,
):
    """rgb `[H, W, 3]`, alpha, depth, instance `[H, W]`, and `unsure` `[H, W]`: where the picture jumps within float32's rounding,
    since a splat is within 1e-4 of the cutoff, or since two that show change places; with jumps, by how much instead.

    placed: (fields, world_from_local, instance id). order: "tile", by depth of the centres, or "pixel", by `ray_depths`, which is
    exact; no termination. world_from_cam_end, ends: what the camera and each of `placed` move to while the image is read out. features: the
    fields hold `features` `[N, C]`; returns their sums `[H, W, C]` as well.
    """
    world_from_cam = camera.world_from_cam if world_from_cam is None else world_from_cam
    lens = camera.lens.params() if lens is None else lens
    optics = type(camera.lens)(*lens.unbind())
    ends = [None] * len(placed) if ends is None else ends
    moving = camera.shutter != "global" and any(end is not None for end in (world_from_cam_end, *ends))
    parts, ways = [], []
    for (g, world_from_local, instance), end in zip(placed, ends, strict=True):
        pose = oracle_lens.pose_at((world_from_cam, world_from_cam_end), (world_from_local, end))
        if isinstance(optics, Pinhole) and not moving:
            part = _pinhole(g, inverse(world_from_cam) @ world_from_local, camera, model, lens)
        else:
            rows, points, axes, sight, *moments = oracle_lens.project(optics, camera, model, pose, g, moving)
            part = points, axes, _shown(g, rows, sight), torch.sigmoid(g["logit_opacities"])[rows], *moments
            if moving:
                ways.append((pose, g["means"][rows], matrix_from_quat(g["quats"][rows]) * g["log_scales"][rows].exp()[:, None, :]))
        parts.append((*part, torch.full((len(part[0]),), instance)))
    points, axes, colour, opacity, mean, covariance, with_depth, instances = (torch.cat(p) for p in zip(*parts, strict=True))
    less = covariance + (0.0 if model.antialias else model.dilation) * torch.eye(2, dtype=torch.float64)
    dilated = covariance + (model.dilation + model.smoothing) * torch.eye(2, dtype=torch.float64)
    if model.antialias or model.smoothing:
        opacity = opacity * (torch.linalg.det(less) / torch.linalg.det(dilated)).clamp_min(0).sqrt()
    conic = torch.linalg.inv(dilated)
    depths = optics.depth(points)
    spread = oracle_lens.depth_offsets(optics, points, axes).norm(dim=-1)
    # the regression of depth on the pixel; half of a depth may be lost over the reach of a splat, which else would reach behind the eye
    slopes = (conic @ with_depth[..., None])[..., 0] * (depths / (2 * REACH * spread)).clamp_max(1)[:, None]
    drawn = (depths, slopes, mean, conic, opacity, colour, instances)
    reach = BEYOND * torch.diagonal(dilated.detach(), dim1=-2, dim2=-1).sqrt()
    rows = []
    for strip in _parts(camera.pixel_centres(), len(points)):
        shown = []
        for pixels in strip:
            # of a part of a large picture only the splats that a float64 could see there
            near = ((mean.detach() - pixels.mean((0, 1))).abs() < reach + 0.5 * pixels.shape[0]).all(1) if len(strip) > 1 else slice(None)
            there = _as_read_out(camera, ways, pixels, near) if moving else (points[None, near], axes[None, near])
            shown.append(_composite(pixels, optics, there, *(t[near] for t in drawn), model.response, order, cutoff, alpha_max))
        rows.append([torch.cat(part, 1) for part in zip(*shown, strict=True)])
    rgb, alpha, depth, instance, jump = (torch.cat(part) for part in zip(*rows, strict=True))
    frame = rgb[..., :3], alpha, depth, instance, jump if jumps else jump > SEEN
    return (*frame, rgb[..., 3:]) if features else frame


def _pinhole(g, cam_from_local: torch.Tensor, camera: Camera, model: SplatModel, lens: torch.Tensor):
    """Points, axes, colours, opacities, and means and covariances, also with depth, of the splats that a pinhole shows."""
    points = g["means"] @ cam_from_local[:3, :3].T + cam_from_local[:3, 3]
    axes = cam_from_local[:3, :3] @ matrix_from_quat(g["quats"]) * g["log_scales"].exp()[:, None, :]
    keep = in_view(points, axes, lens, camera.width, camera.height, model.widening)
    colour = _shown(g, keep, g["means"][keep] - inverse(cam_from_local)[:3, 3])
    points, axes = points[keep], axes[keep]
    if model.projection == "ewa":
        moments = project_ewa(points, axes @ axes.transpose(1, 2), lens, camera.width, camera.height)
    else:
        moments = project_ut(points, axes, lens, camera.width, camera.height)
    return points, axes, colour, torch.sigmoid(g["logit_opacities"][keep]), *moments


def _shown(g: dict[str, torch.Tensor], rows: torch.Tensor, sight: torch.Tensor) -> torch.Tensor:
    """Colours, and beside them the features where there are some."""
    colours = _colours(g["sh"][rows], sight)
    return torch.cat([colours, g["features"][rows]], 1) if "features" in g else colours


def _colours(sh: torch.Tensor, sight: torch.Tensor) -> torch.Tensor:
    return evaluate(sh, sight / sight.norm(dim=-1, keepdim=True))


def colours(placed: Placed, camera: Camera) -> torch.Tensor:
    """What colour `[N, 3]` each splat shows to `camera`, whose rays begin in its eye."""
    eye = (inverse(placed.world_from_local) @ camera.world_from_cam)[:3, 3].detach()
    return _colours(placed.gaussians.sh.detach().double(), placed.gaussians.means.detach().double() - eye)


def truth(placed: list[Placed], camera: Camera, model: SplatModel, order: str = "pixel"):
    """The exact picture: rgb `[H, W, 3]`, and its `jump` `[H, W]`: how far rounding to float32 may move it, where splats change places."""
    with torch.no_grad():
        rgb, _, _, _, jump = render(as_oracle(placed), camera, model, order=order, jumps=True)
    return rgb, jump


def _as_read_out(camera: Camera, ways: list, pixels: torch.Tensor, near) -> tuple[torch.Tensor, torch.Tensor]:
    """Points `[P, N, 3]` and axes `[P, N, 3, 3]` in the camera as it and each instance stand when each of `pixels` is read out."""
    axis, extent = (0, camera.width) if camera.shutter == "columns" else (1, camera.height)
    share = pixels.reshape(-1, 2)[:, axis] / extent
    points, axes = [], []
    for pose, means, local in ways:
        at = pose(share)[:, None]
        points.append(oracle_lens.transformed(at, means))
        axes.append(at[..., :3, :3] @ local)
    return torch.cat(points, 1)[:, near], torch.cat(axes, 1)[:, near]


def _canonical(points: torch.Tensor, axes: torch.Tensor, rays: torch.Tensor, origins: torch.Tensor):
    """Directions and centres `[P, N, 3]` seen from the rays' origins, where each Gaussian is the unit one: A^-1 with A its scaled axes."""
    inverse_axes = (axes / axes.square().sum(-2, keepdim=True)).transpose(-1, -2)
    return torch.einsum("pnij,pj->pni", inverse_axes, rays), torch.einsum("pnij,pnj->pni", inverse_axes, points - origins[:, None])


def ray_depths(points: torch.Tensor, axes: torch.Tensor, rays: torch.Tensor, origins: torch.Tensor) -> torch.Tensor:
    """`[P, N]`: where along each ray `[P, 3]` from its origin `[P, 3]`, in its own lengths, each 3D Gaussian is greatest; with z = 1, a
    depth in metres. points `[P or 1, N, 3]`, axes `[P or 1, N, 3, 3]`.

    With A the Gaussian's scaled axes as columns, t = (A^-1 d) . (A^-1 p) / |A^-1 d|^2 (the order of StopThePop, Radl et al. 2024).
    """
    d, away = _canonical(points, axes, rays, origins)
    return (d * away).sum(-1) / d.square().sum(-1)


def ray_exponents(points: torch.Tensor, axes: torch.Tensor, rays: torch.Tensor, origins: torch.Tensor) -> torch.Tensor:
    """`[P, N]`: half the squared Mahalanobis distance of each 3D Gaussian's centre from the nearest point of each ray (3DGUT, Wu et al.
    2025): at its greatest along the ray; of the eye's own place where that lies behind it, which is not seen."""
    d, away = _canonical(points, axes, rays, origins)
    t = (d * away).sum(-1) / d.square().sum(-1)
    return torch.where(t > 0, 0.5 * (t[..., None] * d - away).square().sum(-1), torch.inf)


def _parts(pixels: torch.Tensor, count: int, room: int = 1 << 21) -> list[tuple[torch.Tensor, ...]]:
    """Rows of square parts of the picture's pixels `[H, W, 2]`; all of it where `count` splats times its pixels is not too much."""
    if pixels.shape[0] * pixels.shape[1] * count <= room:
        return [(pixels,)]
    return [strip.split(PART, 1) for strip in pixels.split(PART, 0)]


def _composite(pixels, lens: Lens, there, depths, slopes, mean, conic, opacity, colour, instances, response, order, cutoff, alpha_max):
    """rgb, alpha, depth, instance and jump of some pixels `[h, w, 2]`."""
    shape, pixels = pixels.shape[:2], pixels.reshape(-1, 2)
    d = pixels[:, None] - mean
    s = 0.5 * torch.einsum("pni,nij,pnj->pn", d, conic, d)
    if response == "ray":
        s = ray_exponents(*there, lens.unproject(pixels), lens.origins(pixels))
    alpha = opacity * torch.exp(-s)
    jump = torch.zeros(len(pixels), dtype=torch.float64)
    if cutoff > 0:
        margin = (opacity / cutoff).log() - s
        jump = (margin.abs() < 1e-4 * (1 + s)).any(1).double()
        alpha = torch.where(margin > 0, alpha, torch.zeros_like(alpha))
    alpha = alpha.clamp_max(alpha_max)
    if order == "pixel":
        with torch.no_grad():
            keys = ray_depths(*there, lens.unproject(pixels), lens.origins(pixels)).nan_to_num()
    else:
        keys = depths.expand_as(alpha)
    # places that are equal, as on pixels that no ray leads to, keep the centres' order
    by_depth = depths.detach().argsort(stable=True)
    first = by_depth[keys.detach()[:, by_depth].argsort(dim=1, stable=True)]
    sorted_alpha = alpha.gather(1, first)
    passing = torch.cumprod(1 - sorted_alpha, 1)
    before = torch.cat([torch.ones(len(pixels), 1, dtype=torch.float64), passing[:, :-1]], 1)
    if order == "pixel":
        depth_step = keys.detach().gather(1, first).diff(dim=1)
        swap = (before * sorted_alpha)[:, :-1] * sorted_alpha[:, 1:] * (colour[first[:, 1:]] - colour[first[:, :-1]]).abs().amax(-1)
        jump = jump + torch.where(depth_step < TIE * depths[first[:, 1:]], swap, torch.zeros_like(swap)).sum(1)
    weight = alpha * before.gather(1, first.argsort(dim=1))
    total = 1 - passing[:, -1] if len(depths) else torch.zeros(len(pixels), dtype=torch.float64)
    drawn = total > 0
    far = depths + torch.einsum("pni,ni->pn", d, slopes)
    if response == "ray":
        far = ray_depths(*there, lens.unproject(pixels), lens.origins(pixels))
        far = torch.where(weight > 0, far, torch.zeros_like(far))
    far = (weight * far).sum(1)
    depth = torch.where(drawn, far / torch.where(drawn, total, torch.ones_like(total)), torch.inf)
    ids = instances.unique()
    of_each = torch.stack([weight.detach()[:, instances == i].sum(1) for i in ids], 1) if len(ids) else None
    who = torch.full((len(pixels),), -1) if of_each is None else ids[of_each.argmax(1)]
    out = (weight @ colour, total, depth, torch.where(total < 0.5, -1, who), jump)
    return tuple(t.reshape(*shape, *t.shape[1:]) for t in out)


def as_oracle(placed: list[Placed]) -> list[tuple[dict[str, torch.Tensor], torch.Tensor, int]]:
    """Placed splats as `render` takes them, all fields and poses leaves that ask for gradients."""
    return [(to_float64(p.gaussians), p.world_from_local.detach().clone().requires_grad_(), p.instance) for p in placed]
