"""The public call: splats and a camera become a picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from numbers import Integral
from typing import overload

import numpy as np
import torch

from render.bands import without_zero_bands
from render.bridge import Rasterize, drawn_only
from render.canonical import canonical_frames
from render.channels import Features, channel_fields, unit
from render.cull import differentiated, in_sight, splats_in_sight
from render.flow import correspond
from render.frame_types import Frame, RenderConfig
from render.kernels.types import Wanted
from render.launch import stage
from render.outputs import check_outputs
from render.projection import check_ends, check_projection, moves, poses
from render.rays import exact_rays, on_device
from render.room import Room
from render.settings import Settings
from scenes.camera import Camera
from scenes.checks import check_tensor
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.poses import inverse

STRETCHED = 0.01
"""What R R^T of a pose's turn is off the unit matrix, summed, from which on it is none; poses that are optimised drift by less."""

_UNIT, _BOTTOM = np.eye(3), np.array([0.0, 0.0, 0.0, 1.0])


@overload
def rasterize(
    splats: Gaussians | Placed | Sequence[Placed],
    camera: Camera,
    outputs: tuple[str, ...] = ...,
    background: torch.Tensor | None = ...,
    flow_to: dict[str, tuple[Sequence[Placed], Camera]] | None = ...,
    model: SplatModel = ...,
    config: RenderConfig = ...,
    features: Features | None = ...,
    crop: tuple[int, int, int, int] | None = ...,
    mask: torch.Tensor | None = ...,
    room: Room | None = ...,
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
    features: Features | None = ...,
    crop: tuple[int, int, int, int] | None = ...,
    mask: torch.Tensor | None = ...,
    room: Room | None = ...,
) -> list[Frame]: ...
def rasterize(
    splats: Gaussians | Placed | Sequence[Placed],
    camera: Camera | Sequence[Camera],
    outputs: tuple[str, ...] = ("rgb", "alpha"),
    background: torch.Tensor | None = None,
    flow_to: dict[str, tuple[Sequence[Placed], Camera]] | None = None,
    model: SplatModel = SplatModel(),  # noqa: B008 - frozen
    config: RenderConfig = RenderConfig(),  # noqa: B008 - frozen
    features: Features | None = None,
    crop: tuple[int, int, int, int] | None = None,
    mask: torch.Tensor | None = None,
    room: Room | None = None,
) -> Frame | list[Frame]:
    """Draw Gaussian splats (Kerbl et al. 2023) as `camera` sees them; one Frame a camera.

    splats: in the world, or placed in it; quaternions of any length; nothing is changed. outputs: names of the fields of `Frame`; what is
    not requested is None and costs nothing. background: `[3]` or `[H, W, 3]`; black otherwise, with rgb premultiplied. flow_to: the
    placed splats and camera at the other time for "prev" and "next"; an instance that is missing there keeps its pose, and what moves
    needs an instance id of its own. features: a further
    field of the splats, `[N, C]` with C to 128, or one for each of the placed. crop: x, y, width, height in pixels, when only that part of
    the image is wanted: bit for bit what the whole shows there. mask: bool `[H, W]`, when only those pixels are wanted; the others
    are empty. room: buffer sizes that earlier frames needed (`render/room.py`), so that the host does not wait for this one; without
    gradients. The frame may lack splats until `room.held` confirms it, as `one_ahead` does.

    rgb, alpha, depth, normal, features and instance_alpha are differentiable in every field of the splats, every pose (camera and
    instance), the lens, the features and the background. Splats whose centre is nearer than 0.1 m are not drawn, nor those that a camera
    drives through while it reads out. What is found out about a tensor of splats is kept until it is written to; torch does not count
    writes through numpy or `.data`, so make a new one for these.
    ValueError for what cannot be drawn.
    """
    outputs = check_outputs(outputs)
    placed = as_placed(splats)
    features = features if features is None or isinstance(features, torch.Tensor) else list(features)
    flow_to = {way: (as_placed(there), other) for way, (there, other) in (flow_to or {}).items()}
    if not isinstance(camera, Camera):
        return [rasterize(placed, c, outputs, background, flow_to, model, config, features, crop, mask, room) for c in camera]
    check(placed, camera, outputs, flow_to, model)
    background = None if background is None else torch.as_tensor(background)
    check_part(camera, background, crop, mask)
    if crop is not None:
        x, y, width, height = crop
        crop = x, y, width, height  # a list would be no key of what is kept
    with stage(placed[0].gaussians.device):
        return _draw(placed, camera, outputs, background, flow_to, model, config, features, crop, mask, room)


def _draw(
    placed: list[Placed], camera: Camera, outputs, background, flow_to, model, config, features=None, crop=None, mask=None, room=None
) -> Frame:
    seen, traced = None, differentiated(placed, camera, features)
    if traced:
        if room is not None:
            raise ValueError("room= takes no gradients, since its frames may lack splats; leave it out, or draw under torch.no_grad()")
    else:
        lean = [without_zero_bands(p.gaussians) for p in placed]
        placed = [p if g is p.gaussians else replace(p, gaussians=g) for p, g in zip(placed, lean, strict=True)]
        seen = in_sight(placed, camera, model)
    cam_from_local = poses(camera, placed)
    summed = channel_fields(outputs, placed, cam_from_local, camera, features)
    channels = torch.cat(list(summed.values()), 1) if summed else None
    if channels is not None and seen is not None:
        channels = channels[splats_in_sight(placed, seen)]
    flows = any(o.startswith(("flow_", "visible_")) for o in outputs)
    settings = Settings(
        width=camera.width,
        height=camera.height,
        model=model,
        config=config,
        wanted=Wanted("depth" in outputs or flows, "median_depth" in outputs, "instance" in outputs or flows, bool(summed)),
        instances=tuple(p.instance for p in placed),
        lens=type(camera.lens),
        shutter=camera.shutter,
        rolling=moves(camera, placed),
        crop=crop,
        mask=None if mask is None else mask.to(placed[0].gaussians.device),
        gradients=torch.is_grad_enabled(),
        room=room,
        splats=sum(len(p.gaussians) for p in placed),
    )
    frames = rays = None
    if settings.by_rays:
        # all gradients of response "ray" go by these; an order has none
        along = model.response == "ray" and traced
        with torch.set_grad_enabled(along and torch.is_grad_enabled()):
            rays, looks = exact_rays(camera, placed, settings.rolling)
            rays, settings = on_device(rays, placed[0].gaussians.device), replace(settings, looks=tuple(looks))
            frames = torch.cat([canonical_frames(*one) for one in _in_camera(placed, camera, looks)]) if along else None
    fields = [t for p in placed for t in p.gaussians.tensors().values()]
    lens = camera.lens.params()
    drawn = (Rasterize.apply if traced else drawn_only)(settings, seen, cam_from_local, lens, channels, frames, rays, *fields)
    frame = picture_of(settings, background if "rgb" in outputs else None, *drawn)
    if settings.wanted.channels:
        parts = frame["sums"].split([field.shape[1] for field in summed.values()], -1)
        frame |= dict(zip(summed, parts, strict=True))
    if "normal" in outputs:
        frame["normal"] = unit(frame["normal"])
    for way in {o.split("_")[1] for o in outputs if o.startswith(("flow_", "visible_"))}:
        there, other = flow_to[way]
        same = correspond(placed, camera, frame["depth"].detach(), frame["instance"], there, other, settings.part[:2])
        frame[f"flow_{way}"] = same.flow
        if f"visible_{way}" in outputs:
            shown = _draw(there, other, ("depth", "alpha"), None, {}, model, config, room=room)
            assert shown.depth is not None and shown.alpha is not None
            # sky there is what would be sky here, as `instance` says
            frame[f"visible_{way}"] = same.visible(shown.depth.detach().where(shown.alpha >= 0.5, torch.inf))
    return Frame(camera=camera, **{name: frame[name] for name in outputs})


def picture_of(settings: Settings, background, rgb, passing, z, weights, sums, median, instance) -> dict[str, torch.Tensor]:
    """A frame's fields by name, and "sums" of all channels `[H, W, C]`, from what `Rasterize` gives."""
    frame = {"alpha": 1 - passing, "rgb": rgb.permute(1, 2, 0), "instance": instance}
    if background is not None:
        behind = background if background.ndim == 1 else background[settings.of_image]
        # not 1 - alpha, which has lost the digits of what little light passes
        frame["rgb"] = frame["rgb"] + passing[..., None] * behind.to(passing)
    if settings.wanted.depth:
        # the safe denominator keeps the gradient finite where nothing was drawn
        drawn = weights > 0
        frame["depth"] = torch.where(drawn, z / torch.where(drawn, weights, torch.ones_like(weights)), torch.inf)
    if settings.wanted.median:
        frame["median_depth"] = torch.where(median > 0, median, torch.inf)
    if settings.wanted.channels:
        frame["sums"] = sums.permute(1, 2, 0)
    return frame


def _in_camera(placed: list[Placed], camera: Camera, looks: list[int]) -> Iterator[tuple[Gaussians, torch.Tensor, int]]:
    cam_from_world = inverse(camera.world_from_cam)
    for p, group in zip(placed, looks, strict=True):
        yield p.gaussians, cam_from_world @ p.world_from_local, group


def as_placed(splats) -> list[Placed]:
    """Splats as `rasterize` takes them, placed; never none."""
    if isinstance(splats, Gaussians):
        splats = Placed(splats, torch.eye(4, dtype=torch.float64))
    placed = [splats] if isinstance(splats, Placed) else list(splats)
    for p in placed:
        if not isinstance(p, Placed):
            raise ValueError(f"a sequence of splats must be of Placed, got {type(p).__name__}; write Placed(splats, pose, instance=...)")
    return placed or [Placed(Gaussians.empty(), torch.eye(4, dtype=torch.float64))]


def check_part(camera: Camera, background, crop, mask) -> None:
    """ValueError for a background, crop or mask that does not fit the camera."""
    if background is not None:
        check_tensor("background", background, (3,) if background.ndim == 1 else (camera.height, camera.width, 3))
    if mask is not None:
        check_tensor("mask", mask, (camera.height, camera.width), torch.bool)
    if crop is not None:
        if len(crop) != 4 or not all(isinstance(n, Integral) for n in crop):
            raise ValueError(f"crop must be four whole numbers of pixels, x, y, width, height, got {crop}")
        x, y, width, height = crop
        if not (x >= 0 and y >= 0 and width >= 1 and height >= 1 and x + width <= camera.width and y + height <= camera.height):
            size = f"{camera.width}x{camera.height}"
            raise ValueError(f"crop must be x, y, width, height of a part of the image, which has {size} pixels, got {crop}")


def check(placed, camera, outputs, flow_to, model) -> None:
    """ValueError for what cannot be drawn, or has no such outputs."""
    if "need" in outputs:
        raise ValueError('output "need" depends on where a scene\'s photos were taken; ask render_frame for it')
    for name in outputs:
        what, _, way = name.partition("_")
        if what in ("flow", "visible") and way not in flow_to:
            raise ValueError(f'output "{name}" needs flow_to={{"{way}": (placed, camera)}}')
    check_poses(placed, camera)
    check_projection(camera, placed, model)
    for there, other in flow_to.values():
        check_poses(there, other)
        check_ends(other, there)
        _check_shared(placed, there)
    devices = {p.gaussians.device for p in placed}
    if len(devices) > 1:
        raise ValueError(f"all splats must be on one device, got {', '.join(sorted(map(str, devices)))}")
    if max(p.instance for p in placed) >= 2**24 or min(p.instance for p in placed) < 0:
        raise ValueError("instance ids must lie between 0 and 2^24 - 1")


def check_poses(placed: Sequence[Placed], camera: Camera) -> None:
    """ValueError for poses that are not finite, or do more than move and turn."""
    given = [camera.world_from_cam, camera.world_from_cam_end]
    for p in placed:
        given += [p.world_from_local, p.world_from_local_end]
    # numpy's small sums take a third of torch's time
    stacked = torch.stack([pose for pose in given if pose is not None]).detach().cpu().numpy()
    with np.errstate(invalid="ignore"):
        turn = stacked[:, :3, :3]
        off = np.abs(turn @ turn.transpose(0, 2, 1) - _UNIT).sum((1, 2))
        sunk = np.abs(stacked[:, 3] - _BOTTOM).sum(1)
        hands = np.linalg.det(turn)
        # one value that is not finite makes the sum so
        fit = (off + 0 * stacked.sum((1, 2)) < STRETCHED) & (sunk < 1e-6) & (hands > 0)
    if not fit.all():
        names = [
            f"{which} of {whose}" for whose in ("camera", *(f"instance {p.instance}" for p in placed)) for which in ("pose", "end pose")
        ]
        named = [(name, pose) for name, pose in zip(names, given, strict=True) if pose is not None]
        for (name, pose), bent, below, hand in zip(named, off.tolist(), sunk.tolist(), hands.tolist(), strict=True):
            if not torch.isfinite(pose).all():
                raise ValueError(f"the {name} is not finite: {pose.tolist()}")
            if below >= 1e-6:
                raise ValueError(f"the {name} has a bottom row other than 0 0 0 1; transpose it if it is by columns: {pose.tolist()}")
            if bent >= STRETCHED:
                raise ValueError(f"the {name} scales or shears, and poses only move and turn; scale the splats: {pose.tolist()}")
            if hand <= 0:
                fix = "of a camera with OpenGL's axes, turn both y and z round, not one of them"
                raise ValueError(f"the {name} mirrors, and poses only move and turn; {fix}: {pose.tolist()}")


def _check_shared(placed: list[Placed], there: list[Placed]) -> None:
    """ValueError where instances of one id go different ways: flow is told by the ids that pixels have."""
    ids = [p.instance for p in placed]
    for id in {i for i in ids if ids.count(i) > 1}:
        now, then = ([p.world_from_local for p in some if p.instance == id] for some in (placed, there))
        ways = [b @ inverse(a) for a, b in zip(now, then or now, strict=False)]
        if len(then) not in (0, len(now)) or any((way - ways[0]).abs().max() > 1e-9 * (1 + ways[0].abs().max()) for way in ways):
            raise ValueError(f"{len(now)} of the Placed have the instance id {id} and move differently; flow needs an id for each")
