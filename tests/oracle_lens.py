"""Truth for any lens and for shutters that move: sigma points through the lens itself, Jacobians by autograd, readouts by fixed point or
by halving.

Float64 torch, differentiable by autograd; where an equation is solved, one Newton step after the solution carries the gradients.
"""

import math
from collections.abc import Callable

import torch

from scenes.camera import Camera
from scenes.gaussians import SplatModel
from scenes.lenses import Equirectangular, Lens, OpenCV, Orthographic, Pinhole
from scenes.lenses.box import view_box
from scenes.poses import interpolate, inverse, matrix_from_quat

NEAR = 0.1
REACH = 3.33
ROOT3 = math.sqrt(3.0)
PoseAt = Callable[[torch.Tensor], torch.Tensor]


def pose_at(cam: tuple, local: tuple) -> PoseAt:
    """cam_from_local `[..., 4, 4]` at shares of the readout `[...]`, from (start, end or None) of camera and instance."""

    def along(start, end, s):
        shape = (*s.shape, 4, 4)
        return start.expand(shape) if end is None else interpolate(start.expand(shape), end.expand(shape), s)

    return lambda s: inverse(along(*cam, s)) @ along(*local, s)


def transformed(pose: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
    return (pose[..., :3, :3] @ x[..., None])[..., 0] + pose[..., :3, 3]


def readout(lens: Lens, camera: Camera, pose: PoseAt, x: torch.Tensor, shift: torch.Tensor, moving: bool) -> torch.Tensor:
    """Share `[...]` of the readout at which local points `[..., 3]`, moved by `shift` in the camera, are seen: the first of several."""
    s = torch.zeros(x.shape[:-1], dtype=torch.float64)
    if not moving:
        return s
    axis, extent = (0, camera.width) if camera.shutter == "columns" else (1, camera.height)

    def where(share):
        return lens.project(transformed(pose(share), x) + shift)[..., axis] / extent

    with torch.no_grad():
        for _ in range(100):
            s = where(s).nan_to_num(0.5).clamp(0, 1)
        low, high = torch.zeros_like(s), torch.ones_like(s)
        for _ in range(60):  # where the point comes so fast that this leads nowhere
            middle = 0.5 * (low + high)
            late = where(middle).nan_to_num(0.5).clamp(0, 1) > middle
            low, high = torch.where(late, middle, low), torch.where(late, high, middle)
        found = (where(s).nan_to_num(0.5).clamp(0, 1) - s).abs() < 1e-9
        halved = torch.where(low == 0, 0.0, torch.where(high == 1, 1.0, 0.5 * (low + high)))
        s = torch.where(found, s, halved)
    with torch.enable_grad():
        leaf = s.detach().requires_grad_()
        (rate,) = torch.autograd.grad(where(leaf).sum(), leaf, allow_unused=True)
    rate = torch.zeros_like(s) if rate is None else rate.detach()  # of what stands still while others move
    inside = (s > 0) & (s < 1)
    return torch.where(inside, s + (where(s) - s) / (1 - rate), s)


def least_depth(n: torch.Tensor, box: tuple[float, float, float, float]) -> torch.Tensor:
    """`[N]`: how near sigma points come, in parts of their centre's depth, of centres at xy / z = `n` `[N, 2]` of a camera that sees `box`
    (left, right, top, bottom): half, and from the view's sides on more, up to all at 1.3 times half the view."""
    left, right, top, bottom = box
    middle = torch.tensor([left + right, top + bottom], dtype=torch.float64) / 2
    half = torch.tensor([right - left, bottom - top], dtype=torch.float64) / 2
    out = ((n - middle) / half).abs().amax(-1)
    return 0.5 + 0.5 * ((out - 1) / 0.3).clamp(0, 1)


def pulled_back(lens: Lens, centre: torch.Tensor, offset: torch.Tensor, least: torch.Tensor) -> torch.Tensor:
    """How many sigma `[N, 6]`, up to sqrt(3), each sigma point goes from `centre` `[N, 1, 3]` along `offset` `[N, 6, 3]`: no nearer than
    `least` `[N, 1]` of the centre's depth, and not out of the lens's domain."""
    edge = math.cos(lens.limit())

    def margins(tau):
        y = centre + tau[..., None] * offset
        if isinstance(lens, Orthographic):
            half = torch.ones_like(tau)
        elif isinstance(lens, Pinhole | OpenCV):
            half = y[..., 2] - least * centre[..., 2]
        else:
            half = (y * centre).sum(-1) - least * centre.square().sum(-1)
        seen = y[..., 2] - edge * y.norm(dim=-1)
        inside = centre[..., 2] > edge * centre.norm(dim=-1)
        return half, torch.where(inside, seen, torch.ones_like(seen))

    full = torch.full(offset.shape[:-1], ROOT3, dtype=torch.float64)
    with torch.no_grad():
        bad = torch.minimum(*margins(full)) < 0
        low, high = torch.zeros_like(full), full.clone()
        for _ in range(80):
            middle = 0.5 * (low + high)
            fits = torch.minimum(*margins(middle)) > 0
            low, high = torch.where(fits, middle, low), torch.where(fits, high, middle)
        tau = torch.where(bad, low.clamp_min(1e-6), full)
    with torch.enable_grad():
        leaf = tau.clone().requires_grad_()
        half, seen = margins(leaf)
        by_half = (half.abs() < seen.abs()) | (seen == 1)
        at = torch.where(by_half, half, seen)
        (rate,) = torch.autograd.grad(at.sum(), leaf, retain_graph=True, allow_unused=True)
    half, seen = margins(tau)
    at = torch.where(by_half, half, seen)
    rate = torch.ones_like(tau) if rate is None else rate.detach()
    # only the gradient of Newton's step: where a point may come no nearer than its centre, the step itself leads to 0
    return torch.where(bad, tau - (at - at.detach()) / torch.where(bad, rate, torch.ones_like(rate)), tau)


def aimed(lens: Lens, camera: Camera, points: torch.Tensor) -> torch.Tensor:
    """The centres, no further out than 1.3 times half the view where the lens sees only what lies before it."""
    if not isinstance(lens, Pinhole | OpenCV):
        return points
    left, right, top, bottom = view_box(lens, camera.width, camera.height)
    out_x, out_y = 0.15 * (right - left), 0.15 * (bottom - top)
    x, y, z = points.unbind(-1)
    return torch.stack([(x / z).clamp(left - out_x, right + out_x) * z, (y / z).clamp(top - out_y, bottom + out_y) * z, z], -1)


def depth_offsets(lens: Lens, points: torch.Tensor, axes: torch.Tensor) -> torch.Tensor:
    """`[n, 3]`: how much farther, to first order, the ends of axes `[n, 3, 3]` are than their centres `[n, 3]`."""
    if isinstance(lens, Pinhole | OpenCV | Orthographic):
        return axes[:, 2]
    return ((points / points.norm(dim=-1, keepdim=True))[:, None] @ axes)[:, 0]


def shown(lens: Lens, camera: Camera, model: SplatModel, points: torch.Tensor, axes: torch.Tensor) -> torch.Tensor:
    """Mask of splats in the lens's domain, beyond the near plane, whose ellipsoid is not wholly beyond one side of the view."""
    seen = lens.valid(points) & (lens.depth(points) > NEAR)
    if isinstance(lens, Pinhole | OpenCV):
        left, right, top, bottom = view_box(lens, camera.width, camera.height, 4 * math.sqrt(model.widening) + 1)
        for plane in ([1, 0, -right], [-1, 0, left], [0, 1, -bottom], [0, -1, top]):
            normal = torch.tensor(plane, dtype=torch.float64)
            seen &= points @ normal <= REACH * (axes.transpose(1, 2) @ normal).norm(dim=-1)
    return seen


def project(lens: Lens, camera: Camera, model: SplatModel, pose: PoseAt, g: dict[str, torch.Tensor], moving: bool):
    """Of the splats `g` that show: their rows, points and axes in the camera, directions of sight in the local frame, and mean
    `[n, 2]` and covariance `[n, 2, 2]` in pixels, and `[n, 2]` with depth; those beyond an image's seam twice."""
    still = torch.zeros_like(g["means"])
    s = readout(lens, camera, pose, g["means"], still, moving)
    at = pose(s)
    points = transformed(at, g["means"])
    local = matrix_from_quat(g["quats"]) * g["log_scales"].exp()[:, None, :]
    axes = at[..., :3, :3] @ local
    ends = [lens.depth(transformed(pose(torch.full_like(s, end)), g["means"])) for end in (0.0, 1.0)]
    driven_through = torch.minimum(*ends) <= NEAR  # while the image is read out
    rows = (shown(lens, camera, model, points, axes) & ~driven_through).nonzero()[:, 0]
    points, axes, local, means = points[rows], axes[rows], local[rows], g["means"][rows]
    along = torch.tensor([0.0, 0, 1], dtype=torch.float64).expand_as(points) if isinstance(lens, Orthographic) else points
    sight = (at[rows, :3, :3].transpose(1, 2) @ along[..., None])[..., 0]
    mean = lens.project(points)
    aim = aimed(lens, camera, points)
    farther = depth_offsets(lens, points, axes)
    if model.projection == "ewa":
        jacobian = torch.func.vmap(torch.func.jacrev(lens.project))(aim) if len(aim) else torch.zeros(0, 2, 3, dtype=torch.float64)
        e = jacobian @ axes
        covariance = e @ e.transpose(1, 2)
        with_depth = (e @ farther[..., None])[..., 0]
    else:
        signs = torch.tensor([1.0, -1.0], dtype=torch.float64)
        offsets = (local.transpose(1, 2)[:, :, None] * signs[:, None]).flatten(1, 2)  # [n, 6, 3], local
        in_camera = (at[rows, None, :3, :3] @ offsets[..., None])[..., 0]
        least = torch.full_like(aim[:, 0], 0.5)
        if isinstance(lens, Pinhole | OpenCV):
            least = least_depth(aim[:, :2] / aim[:, 2:], view_box(lens, camera.width, camera.height))
        tau = pulled_back(lens, aim[:, None], in_camera, least[:, None])
        shift = (aim - points)[:, None]
        x = torch.cat([means[:, None], means[:, None] + tau[..., None] * offsets], 1)  # [n, 7, 3]
        seven = readout(lens, camera, pose, x, shift, moving)
        pixels = lens.project(transformed(pose(seven), x) + shift)
        d = pixels[:, 1:] - pixels[:, :1]
        if isinstance(lens, Equirectangular):
            turns = (d[..., 0] / lens.period()).detach().round() * lens.period()
            d = torch.stack([d[..., 0] - turns, d[..., 1]], -1)
        d = d * (ROOT3 / tau)[..., None]
        moved = d.mean(1)  # weights 0 for the centre and 1/6 for the others
        mean = mean + moved
        d = torch.cat([-moved[:, None], d - moved[:, None]], 1)
        weights = torch.tensor([2.0] + [1 / 6] * 6, dtype=torch.float64)
        covariance = torch.einsum("k,nki,nkj->nij", weights, d, d)
        with_depth = torch.einsum("k,nki,nk->ni", weights[1:], d[:, 1:], ROOT3 * (farther[:, :, None] * signs).flatten(1))
    if isinstance(lens, Equirectangular) and model.response == "conic":  # a ray meets a splat once, on whichever side of the seam
        whole = ((0.5 * camera.width - mean[:, :1]) / lens.period()).detach().round() * lens.period()  # to where the picture is
        mean = mean + torch.cat([whole, torch.zeros_like(whole)], 1)
        other = torch.where(mean[:, :1] < 0.5 * camera.width, lens.period(), -lens.period())
        copies = torch.cat([mean, mean + torch.cat([other, torch.zeros_like(other)], 1)])
        rows, points, axes, sight, covariance, with_depth = (torch.cat([t, t]) for t in (rows, points, axes, sight, covariance, with_depth))
        mean = copies
    return rows, points, axes, sight, mean, covariance, with_depth
