"""Which kernels project for a camera, and what they are told of it: the only place beside the kernels that knows lenses and shutters."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from render.kernels.lenses import LENS_FUNCTIONS
from render.kernels.lenses.optics import PARAMS, Optics
from render.kernels.lenses.optics import params as vec_params
from render.kernels.motion import POWERS
from render.kernels.project import project, project_backward
from render.kernels.project_lens import POSE, lens_kernels
from render.kernels.types import View
from scenes.camera import Camera
from scenes.gaussians import Placed, SplatModel
from scenes.lenses import Equirectangular, Lens, OpenCV, Pinhole
from scenes.lenses.box import view_box
from scenes.poses import interpolate, inverse

if TYPE_CHECKING:
    from render.settings import Settings

NEAR = 0.1
"""Metres in front of the camera within which a splat's centre is not drawn; around it, for a lens that sees all around."""

WIDEST = 1.01
"""Turns that an equirectangular image may be wide: each splat is drawn once more beyond the seam, not twice. One in full, and a little for
lenses that are optimised."""

LARGEST_TURN = math.radians(60)
"""How far a pose may turn while the image is read out: where camera and instance both do, against each other, what the kernels write
their motion by (`kernels/motion.py`) is off by 1e-4 of a radian."""

READINGS = 20
"""Steps towards the moment at which a point is read out: of one that moves by a tenth of the image meanwhile, 1e-20 is left."""

_NODES = torch.linspace(0, 1, POWERS, dtype=torch.float64)
_POLYNOMIAL = torch.linalg.inv(_NODES[:, None] ** torch.arange(POWERS))
"""Coefficients of the polynomial through values at the nodes."""


def moves(camera: Camera, placed: Sequence[Placed]) -> bool:
    """Whether anything moves while the image is read out."""
    ends = [camera.world_from_cam_end, *(p.world_from_local_end for p in placed)]
    return camera.shutter != "global" and any(end is not None for end in ends)


def poses(camera: Camera, placed: Sequence[Placed]) -> torch.Tensor:
    """float64 `[P, C, 4, 4]`: cam_from_local of each instance as coefficients of the powers of the readout's share, C = 1 where nothing
    moves. Composed in float64, differentiable in every pose; all on the cameras' device."""
    if not moves(camera, placed):
        return (inverse(camera.world_from_cam) @ torch.stack([p.world_from_local for p in placed]))[:, None]
    cam_from_world = inverse(_along(camera.world_from_cam, camera.world_from_cam_end))
    nodes = torch.stack([cam_from_world @ _along(p.world_from_local, p.world_from_local_end) for p in placed])
    return torch.einsum("kn,pnij->pkij", _POLYNOMIAL.to(nodes.device), nodes)


def at_their_moments(camera: Camera, cam_from_local: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """float64 `[N, 4, 4]`: an instance's pose, one of `poses`, as each of its `points` `[N, 3]` is read out, on their device; `[1, 4, 4]`
    where nothing moves. Differentiable: the moment's gradient is its equation's (implicit function theorem)."""
    cam_from_local = cam_from_local.to(points.device)
    if len(cam_from_local) == 1:
        return cam_from_local
    points = points.to(torch.float64)
    axis, extent = (0, camera.width) if camera.shutter == "columns" else (1, camera.height)

    def pose(share: torch.Tensor) -> torch.Tensor:
        return torch.einsum("nk,kij->nij", share[:, None] ** torch.arange(POWERS, device=share.device), cam_from_local)

    def line(share: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        at = pose(share)
        return camera.lens.project((at[:, :3, :3] @ points[:, :, None])[..., 0] + at[:, :3, 3])[:, axis] / extent

    with torch.no_grad():
        share = torch.full_like(points[:, 0], 0.5)
        for _ in range(READINGS):
            share = line(share, points).nan_to_num(0.5).clamp(0, 1)
        (seen,) = ((line(share, points) - share).abs() < 1e-6).nonzero(as_tuple=True)  # others have no gradient, which might be nan
    at, those = share[seen], points[seen]
    with torch.enable_grad():
        leaf = at.clone().requires_grad_()
        (rate,) = torch.autograd.grad(line(leaf, those).sum(), leaf)
    return pose(share.index_put((seen,), at + (line(at, those) - at) / (1 - rate)))


def _along(start: torch.Tensor, end: torch.Tensor | None) -> torch.Tensor:
    """The pose `[POWERS, 4, 4]` at the polynomial's nodes."""
    if end is None:
        return start.expand(POWERS, 4, 4)
    return interpolate(start.expand(POWERS, 4, 4), end.expand(POWERS, 4, 4), _NODES.to(start.device))


def check_ends(camera: Camera, placed: Sequence[Placed]) -> None:
    """ValueError where something has an end pose that this camera's shutter cannot have."""
    ends = [("the camera", camera.world_from_cam, camera.world_from_cam_end)]
    ends += [(f"instance {p.instance}", p.world_from_local, p.world_from_local_end) for p in placed]
    for name, start, end in ends:
        if end is None:
            continue
        if camera.shutter == "global":
            raise ValueError(f'{name} has an end pose, which a global shutter never sees; use shutter="rows" or "columns", or no end pose')
        turn = math.acos(min(1.0, max(-1.0, (float((start[:3, :3] * end[:3, :3]).detach().sum()) - 1) / 2)))
        if turn > LARGEST_TURN:
            raise ValueError(f"{name} turns by {math.degrees(turn):.0f} degrees while the image is read out; at most 60 can be drawn")


def check_projection(camera: Camera, placed: Sequence[Placed], model: SplatModel) -> None:
    """ValueError naming what this camera cannot draw, and the way out."""
    check_ends(camera, placed)
    turn = abs(float(camera.lens.period().detach())) if isinstance(camera.lens, Equirectangular) else math.inf
    if camera.width > WIDEST * turn:
        raise ValueError(
            f"an equirectangular image shows one turn at most, which is {turn:.1f} pixels wide with this fx, got width {camera.width}; "
            f"make fx {camera.width / (2 * math.pi):g} or the image narrower"
        )
    if not moves(camera, placed):
        return
    if model.projection != "ut":
        raise ValueError(
            f'a shutter that moves is drawn with projection "ut" only, not "{model.projection}"; retrain with it, or use shutter="global"'
        )
    if isinstance(camera.lens, Equirectangular) and camera.shutter == "columns":
        raise ValueError('an equirectangular image read out by columns has no time at its seam; use shutter="rows" or "global"')


@dataclass(frozen=True)
class Projection:
    """The kernels for a lens under a shutter, and how often each instance is drawn (twice where the image closes on itself)."""

    forward: wp.Kernel
    backward: wp.Kernel
    powers: int
    params: int
    copies: int = 1

    @property
    def uniforms(self) -> int:
        """Numbers of one row of the gradient that all splats share."""
        return POSE * self.powers + self.params

    def pose_gradient(self, shared: torch.Tensor) -> torch.Tensor:
        """`[P, C, 4, 4]`, as `poses`, from rows `[P, uniforms]`."""
        parts = shared[:, : POSE * self.powers].reshape(-1, self.powers, POSE)
        g = shared.new_zeros(len(shared), self.powers, 4, 4)
        g[..., :3, :3] = parts[..., :9].reshape(-1, self.powers, 3, 3)
        g[..., :3, 3] = parts[..., 9:]
        return g

    def lens_gradient(self, shared: torch.Tensor, count: int) -> torch.Tensor:
        """`[count]`: of the lens's parameters."""
        return shared[:, POSE * self.powers :].sum(0)[:count]


def projection(lens: type[Lens], rolling: bool) -> Projection:
    """The projection of a lens type; the pinhole with a global shutter has kernels of its own."""
    if lens is Pinhole and not rolling:
        return Projection(project, project_backward, 1, 4)
    kernels = lens_kernels(LENS_FUNCTIONS[lens.kind], rolling)
    return Projection(kernels.forward, kernels.backward, POWERS if rolling else 1, PARAMS, 2 if lens is Equirectangular else 1)


def uniforms(settings: Settings, lens: Lens, poses: torch.Tensor, copies: int) -> list:
    """What the kernels of `projection` are told of the camera and, as rows, of all instances with `poses` `[P, C, 4, 4]`."""
    view = _view(replace(settings, mask=None, instances=(), looks=(), room=None), lens)  # a key that is kept must not keep a mask
    if isinstance(lens, Pinhole) and not settings.rolling:
        cam_from_local = poses[:, 0].numpy()
        rotation, translation = cam_from_local[:, :3, :3], cam_from_local[:, :3, 3]
        eye = -(translation[:, None] @ rotation)[:, 0]
        rows = [rotation.reshape(-1, 9), translation, eye, np.array(settings.instances, dtype=np.float64)[:, None]]
        return [view, torch.from_numpy(np.concatenate(rows, 1))]
    instances = torch.tensor(settings.instances, dtype=torch.float64)[:, None]
    optics = optics_of(lens, settings.width)
    powers = torch.cat([poses[..., :3, :3].flatten(2), poses[..., :3, 3]], 2)
    powers = torch.nn.functional.pad(powers, (0, 0, 0, POWERS - powers.shape[1])).flatten(1)
    by_rows = settings.shutter != "columns"
    shutter = torch.tensor([by_rows, settings.height if by_rows else settings.width], dtype=torch.float64).expand(len(poses), 2)
    rows = [torch.cat([powers, shutter, instances, torch.full_like(instances, copy)], 1) for copy in range(copies)]
    return [view, optics, torch.cat(rows)]


def optics_of(lens: Lens, width: int) -> Optics:
    """The lens of a picture as kernels are told of it."""
    optics = Optics()
    optics.p = vec_params(*lens.params().tolist(), *([0.0] * (PARAMS - len(lens.params()))))
    optics.cos_limit, optics.sin_limit = math.cos(lens.limit()), math.sin(lens.limit())
    optics.period = float(lens.period()) if isinstance(lens, Equirectangular) else 0.0
    optics.middle = 0.5 * width
    return optics


@lru_cache(maxsize=16)
def _view(settings: Settings, lens: Lens) -> View:
    """The same for all instances of a frame and all frames of a camera, so kept: nobody writes to it."""
    v = View()
    if isinstance(lens, Pinhole):
        params = lens.params().tolist()
        v.lens = wp.vec4d(*params)
    if isinstance(lens, Pinhole | OpenCV):
        left, right, top, bottom = view_box(lens, settings.width, settings.height)
        half_x, half_y = 0.15 * (right - left), 0.15 * (bottom - top)  # the 0.3 of 1.3 tan, on either side
        v.clamp_left, v.clamp_right, v.clamp_top, v.clamp_bottom = left - half_x, right + half_x, top - half_y, bottom + half_y
        v.middle, v.per_half = wp.vec2d((left + right) / 2, (top + bottom) / 2), wp.vec2d(2 / (right - left), 2 / (bottom - top))
        margin = 4 * math.sqrt(settings.model.widening) + 1
        v.left, v.right, v.top, v.bottom = view_box(lens, settings.width, settings.height, margin)
    v.tile_left, v.tile_top, v.tiles_x, v.tiles_y = settings.tile_left, settings.tile_top, settings.tiles_x, settings.tiles_y
    v.along_rays = int(settings.model.response == "ray")
    v.dilation, v.smoothing = settings.model.widening, settings.model.compensated
    v.near, v.cutoff, v.log_cutoff = NEAR, settings.cutoff, -math.log(settings.cutoff)
    v.unscented = int(settings.model.projection == "ut")
    return v
