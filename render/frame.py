"""A frame: the splats of a scene at a camera's time, then shadows of inserted assets, the sky behind them, and the camera's exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch

from render.flat_field import in_flat_field
from render.frame_types import Frame, RenderConfig
from render.launch import upload
from render.need import need_of, support_fields
from render.outputs import check_scene_outputs
from render.rasterize import rasterize
from render.room import Room
from render.shadow import cast, caster_fields, shadow_casters
from render.sky import over_sky
from scenes.camera import Camera, neutral_exposure
from scenes.gaussians import Placed
from scenes.scene import Scene

DEFAULT = RenderConfig()


def render_frame(
    scene: Scene,
    camera: Camera,
    outputs: tuple[str, ...] = ("rgb",),
    previous: Camera | None = None,
    following: Camera | None = None,
    shadows: bool = True,
    config: RenderConfig = DEFAULT,
    room: Room | None = None,
) -> Frame:
    """Background and actors at `camera.time_us`, shadows of inserted assets, the sky, and last the camera's exposure.

    previous, following: the cameras that flow_prev and flow_next lead to, and visible_prev and visible_next; needed exactly where those
    are asked for. instance_alpha has a channel for each id, `[H, W, 1 + actors]`, whichever of them are there at the time.
    Shadows and sky cost nothing where there is nothing to do. Differentiable as `rasterize` is, and in the sky. room: as of `rasterize`.
    Raises ValueError for an output that does not exist and for a flow without its other camera.
    """
    outputs = check_scene_outputs(outputs)
    others = {"prev": previous, "next": following}
    ways = {way: [o for o in (f"flow_{way}", f"visible_{way}") if o in outputs] for way in others}
    for way, asked in ways.items():
        if asked and others[way] is None:
            raise ValueError(f"{asked[0]} needs the camera it leads to; pass {'previous' if way == 'prev' else 'following'}=")
    flow_to: dict[str, tuple[Sequence[Placed], Camera]] = {
        way: (scene.placed(c.time_us, c.readout_us), c) for way, c in others.items() if c is not None and ways[way]
    }

    needed = set(outputs) - {"need"}
    if "need" in outputs:
        needed |= {"rgb", "alpha", "depth", "instance"}
    casters = shadow_casters(scene, camera) if shadows and "rgb" in needed else []
    if "rgb" in needed and scene.sky is not None:
        needed.add("alpha")
    if casters:
        needed |= {"alpha", "depth", "instance"}
    placed = scene.placed(camera.time_us, camera.readout_us)
    fields = {"casters": caster_fields(casters, placed)} if casters else {}
    if "need" in outputs:
        fields["need"] = support_fields(placed, camera)
    features = [torch.cat(parts, 1) for parts in zip(*fields.values(), strict=True)] if fields else None
    needed |= {"features"} if fields else set()
    frame = rasterize(placed, camera, tuple(sorted(needed)), None, flow_to or None, scene.model_for(camera), config, features, room=room)

    rgb = frame.rgb
    support = frame.features
    if casters:
        assert frame.features is not None and frame.alpha is not None
        shares, support = frame.features.tensor_split([fields["casters"][0].shape[1]], -1)
        rgb = cast(frame, casters, shares / frame.alpha[..., None].clamp_min(1e-6))
    need = None
    if "need" in outputs:
        assert rgb is not None and frame.rgb is not None
        need = need_of(scene, replace(frame, features=support), rgb.ne(frame.rgb).any(-1))
    if "rgb" in outputs:
        assert rgb is not None
        if scene.sky is not None:
            assert frame.alpha is not None
            rgb = over_sky(rgb, frame.alpha, scene.sky, camera)
        rgb = expose(rgb, camera)
    if frame.instance_alpha is not None:
        frame = replace(frame, instance_alpha=by_instance(frame.instance_alpha, placed, len(scene.actors)))
    wanted = {name: getattr(frame, name) for name in outputs}
    return Frame(camera, **wanted | {"need": need, "rgb": rgb if "rgb" in outputs else None})


def by_instance(each: torch.Tensor, placed: Sequence[Placed], actors: int) -> torch.Tensor:
    """What each of the placed adds, `[H, W, P]`, by instance id `[H, W, 1 + actors]`: 0 of actors that are not there at that time."""
    return each.new_zeros(*each.shape[:2], 1 + actors).index_add(2, torch.tensor([p.instance for p in placed], device=each.device), each)


def expose(rgb: torch.Tensor, camera: Camera) -> torch.Tensor:
    """A picture `[H, W, 3]` as a camera takes it: rgb' = F (E[:, :3] rgb + E[:, 3]), of its exposure and flat field."""
    exposure = camera.exposure
    if exposure is not None and (exposure.requires_grad or not torch.equal(exposure, neutral_exposure().to(exposure))):
        exposure = upload(exposure, rgb.device).to(rgb.dtype)
        rgb = rgb @ exposure[:, :3].T + exposure[:, 3]
    return in_flat_field(rgb, camera.flat_field)
