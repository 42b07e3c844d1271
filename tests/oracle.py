"""Truth: the splat model in float64 torch, slow and obviously right, differentiable by autograd.

Written from the papers' matrices (Zwicker et al. 2001; Julier and Uhlmann 1997 with alpha = 1, beta = 2, kappa = 0), not from the
kernels' factored form, so that an error in that algebra shows.
"""

import math

import torch

from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.harmonics import evaluate
from scenes.poses import inverse, matrix_from_quat

NEAR = 0.1
NEAREST = 0.5
REACH = 3.33


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
    return mean, jacobian @ covariance @ jacobian.transpose(-1, -2)


def project_ut(points: torch.Tensor, axes: torch.Tensor, lens: torch.Tensor, width: int, height: int):
    """Sigma points at +-sqrt(3) along `axes` (columns, scaled); one nearer than half the centre's depth lies at that half."""
    fx, fy, cx, cy = lens
    root = math.sqrt(3.0)
    centre = points[:, :2] / points[:, 2:]
    n = clamped(points, lens, width, height)
    sigma = []
    for sign in (root, -root):
        offset = sign * axes.transpose(1, 2)  # [N, 3 axes, 3]
        depth = torch.maximum(points[:, None, 2] + offset[..., 2], NEAREST * points[:, None, 2])
        # the offset from the sight line n = xy / z is divided by the sigma point's own depth
        sigma.append(centre[:, None] + (offset[..., :2] - n[:, None] * offset[..., 2:]) / depth[..., None])
    pixels = torch.cat([centre[:, None], *sigma], 1) * torch.stack([fx, fy]) + torch.stack([cx, cy])  # [N, 7, 2]
    mean_weights = torch.tensor([0.0] + [1 / 6] * 6, dtype=torch.float64)
    covariance_weights = torch.tensor([2.0] + [1 / 6] * 6, dtype=torch.float64)
    mean = (mean_weights[:, None] * pixels).sum(1)
    d = pixels - mean[:, None]
    return mean, torch.einsum("k,nki,nkj->nij", covariance_weights, d, d)


def render(
    placed: list[tuple[dict[str, torch.Tensor], torch.Tensor, int]],
    camera: Camera,
    model: SplatModel,
    world_from_cam: torch.Tensor | None = None,
    lens: torch.Tensor | None = None,
    cutoff: float = 0.0,
    alpha_max: float = 1.0,
):
    """rgb `[H, W, 3]`, alpha, depth, instance `[H, W]`, and `near_cutoff` `[H, W]`: pixels where a splat is within 1e-4 of the cutoff.

    placed: (fields, world_from_local, instance id). Exact order by depth of the centres, no termination.
    """
    world_from_cam = camera.world_from_cam if world_from_cam is None else world_from_cam
    lens = camera.lens.params() if lens is None else lens
    cam_from_world = inverse(world_from_cam)
    parts = []
    for g, world_from_local, instance in placed:
        cam_from_local = cam_from_world @ world_from_local
        points = g["means"] @ cam_from_local[:3, :3].T + cam_from_local[:3, 3]
        eye = inverse(cam_from_local)[:3, 3]
        sight = g["means"] - eye
        colour = evaluate(g["sh"], sight / sight.norm(dim=-1, keepdim=True))
        axes = cam_from_local[:3, :3] @ matrix_from_quat(g["quats"]) * g["log_scales"].exp()[:, None, :]
        parts.append((points, axes, colour, torch.sigmoid(g["logit_opacities"]), torch.full((len(points),), instance)))
    points, axes, colour, opacity, instances = (torch.cat(p) for p in zip(*parts, strict=True))
    keep = in_view(points, axes, lens, camera.width, camera.height, model.dilation)
    points, axes, colour, opacity, instances = (t[keep] for t in (points, axes, colour, opacity, instances))
    if model.projection == "ewa":
        mean, covariance = project_ewa(points, axes @ axes.transpose(1, 2), lens, camera.width, camera.height)
    else:
        mean, covariance = project_ut(points, axes, lens, camera.width, camera.height)
    dilated = covariance + model.dilation * torch.eye(2, dtype=torch.float64)
    if model.antialias:
        opacity = opacity * (torch.linalg.det(covariance) / torch.linalg.det(dilated)).clamp_min(0).sqrt()
    conic = torch.linalg.inv(dilated)

    pixels = camera.pixel_centres()
    through = torch.ones(camera.height, camera.width, dtype=torch.float64)
    rgb = torch.zeros(camera.height, camera.width, 3, dtype=torch.float64)
    depth = torch.zeros_like(through)
    most, who = torch.zeros_like(through), torch.full(through.shape, -1)
    near_cutoff = torch.zeros(through.shape, dtype=torch.bool)
    for i in points[:, 2].argsort(stable=True):
        d = pixels - mean[i]
        s = 0.5 * torch.einsum("hwi,ij,hwj->hw", d, conic[i], d)
        alpha = opacity[i] * torch.exp(-s)
        if cutoff > 0:
            margin = (opacity[i] / cutoff).log() - s
            near_cutoff |= margin.abs() < 1e-4 * (1 + s)
            alpha = torch.where(margin > 0, alpha, torch.zeros_like(alpha))
        alpha = alpha.clamp_max(alpha_max)
        weight = through * alpha
        rgb = rgb + weight[..., None] * colour[i]
        depth = depth + weight * points[i, 2]
        leads = weight.detach() > most
        most, who = torch.where(leads, weight.detach(), most), torch.where(leads, instances[i], who)
        through = through * (1 - alpha)
    alpha = 1 - through
    drawn = alpha > 0
    depth = torch.where(drawn, depth / torch.where(drawn, alpha, torch.ones_like(alpha)), torch.inf)
    return rgb, alpha, depth, torch.where(alpha < 0.5, -1, who), near_cutoff


def as_oracle(placed: list[Placed]) -> list[tuple[dict[str, torch.Tensor], torch.Tensor, int]]:
    """Placed splats as `render` takes them, all fields and poses leaves that ask for gradients."""
    return [(to_float64(p.gaussians), p.world_from_local.detach().clone().requires_grad_(), p.instance) for p in placed]
