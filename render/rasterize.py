"""The public call: splats and a camera become a picture."""

from __future__ import annotations

from collections.abc import Sequence
from typing import overload

import torch

from render.bridge import Rasterize, Settings
from render.flow import image_flow
from render.frame_types import Frame, RenderConfig
from render.launch import stage
from render.outputs import check_outputs
from render.projection import check_projection, moves, poses
from scenes.camera import Camera
from scenes.checks import check_tensor
from scenes.gaussians import Gaussians, Placed, SplatModel


@overload
def rasterize(
    splats: Gaussians | Placed | Sequence[Placed],
    camera: Camera,
    outputs: tuple[str, ...] = ...,
    background: torch.Tensor | None = ...,
    flow_to: dict[str, tuple[Sequence[Placed], Camera]] | None = ...,
    model: SplatModel = ...,
    config: RenderConfig = ...,
) -> Frame: ...
@overload
def rasterize(
    splats: Gaussians | Placed | Sequence[Placed],
    camera: Sequence[Camera],
    outputs: tuple[str, ...] = ...,
    background: torch.Tensor | None = ...,
    flow_to: dict[str, tuple[Sequence[Placed], Camera]] | None = ...,
    model: SplatModel = ...,
    config: RenderConfig = ...,
) -> list[Frame]: ...
def rasterize(
    splats: Gaussians | Placed | Sequence[Placed],
    camera: Camera | Sequence[Camera],
    outputs: tuple[str, ...] = ("rgb", "alpha"),
    background: torch.Tensor | None = None,
    flow_to: dict[str, tuple[Sequence[Placed], Camera]] | None = None,
    model: SplatModel = SplatModel(),  # noqa: B008 - frozen
    config: RenderConfig = RenderConfig(),  # noqa: B008 - frozen
) -> Frame | list[Frame]:
    """Draw Gaussian splats (Kerbl et al. 2023) as `camera` sees them; one Frame a camera.

    splats: in the world, or placed in it; quaternions of any length; nothing is changed. outputs: any of rgb, alpha, depth,
    instance, flow_prev, flow_next; what is not asked for is None and costs nothing. background: `[3]` or `[H, W, 3]`; black
    otherwise, with rgb premultiplied. flow_to: the placed splats and camera at the other time for "prev" and "next"; an
    instance that is missing there keeps its pose.

    rgb, alpha and depth are differentiable in every field of the splats, every pose (camera and instance), the lens and the
    background. Splats whose centre is nearer than 0.1 m are not drawn. ValueError for what cannot be drawn.
    """
    if not isinstance(camera, Camera):
        return [rasterize(splats, c, outputs, background, flow_to, model, config) for c in camera]
    outputs = check_outputs(outputs)
    placed = _as_placed(splats)
    _check(placed, camera, outputs, flow_to, model)
    if background is not None:
        check_tensor("background", background, (3,) if background.ndim == 1 else (camera.height, camera.width, 3))

    flows = any(o.startswith("flow_") for o in outputs)
    settings = Settings(
        width=camera.width,
        height=camera.height,
        model=model,
        config=config,
        depth="depth" in outputs or flows,
        instance="instance" in outputs or flows,
        instances=tuple(p.instance for p in placed),
        lens=type(camera.lens),
        shutter=camera.shutter,
        rolling=moves(camera, placed),
    )
    with stage(placed[0].gaussians.device):
        return _draw(settings, placed, camera, outputs, background, flow_to)


def _draw(settings: Settings, placed: list[Placed], camera: Camera, outputs, background, flow_to) -> Frame:
    fields = [t for p in placed for t in p.gaussians.tensors().values()]
    rgb, alpha, z, weights, instance = Rasterize.apply(settings, poses(camera, placed), camera.lens.params(), *fields)

    frame: dict[str, torch.Tensor] = {}
    if "rgb" in outputs:
        frame["rgb"] = rgb.permute(1, 2, 0)
        if background is not None:
            frame["rgb"] = frame["rgb"] + (1 - alpha)[..., None] * background
    if "alpha" in outputs:
        frame["alpha"] = alpha
    if settings.depth:
        # the safe denominator keeps the gradient finite where nothing was drawn
        drawn = weights > 0
        depth = torch.where(drawn, z / torch.where(drawn, weights, torch.ones_like(weights)), torch.inf)
        if "depth" in outputs:
            frame["depth"] = depth
    if "instance" in outputs:
        frame["instance"] = instance
    for name in (o for o in outputs if o.startswith("flow_")):
        assert flow_to is not None
        there, other = flow_to[name.removeprefix("flow_")]
        frame[name] = image_flow(placed, camera, depth.detach(), instance, there, other)
    return Frame(camera=camera, **frame)


def _as_placed(splats) -> list[Placed]:
    if isinstance(splats, Gaussians):
        splats = Placed(splats, torch.eye(4, dtype=torch.float64))
    placed = [splats] if isinstance(splats, Placed) else list(splats)
    return placed or [Placed(Gaussians.empty(), torch.eye(4, dtype=torch.float64))]


def _check(placed, camera, outputs, flow_to, model) -> None:
    for name in outputs:
        if name.startswith("flow_") and name.removeprefix("flow_") not in (flow_to or {}):
            raise ValueError(f'output "{name}" needs flow_to={{"{name.removeprefix("flow_")}": (placed, camera)}}')
    if model.response != "conic":
        raise ValueError(f'response "{model.response}" is not drawn yet; use SplatModel(response="conic")')
    check_projection(camera, placed, model)
    if flow_to and moves(camera, placed):
        raise ValueError('flow is not drawn while a shutter moves; use shutter="global" and no end poses')
    devices = {p.gaussians.device for p in placed}
    if len(devices) > 1:
        raise ValueError(f"all splats must be on one device, got {', '.join(sorted(map(str, devices)))}")
    for name, pose in [("camera", camera.world_from_cam)] + [(f"instance {p.instance}", p.world_from_local) for p in placed]:
        if not torch.isfinite(pose).all():
            raise ValueError(f"the pose of {name} is not finite: {pose.tolist()}")
    if max(p.instance for p in placed) >= 2**24 or min(p.instance for p in placed) < 0:
        raise ValueError("instance ids must lie between 0 and 2^24 - 1")
