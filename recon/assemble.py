"""The scene that a fit has reached: splats, actors, cameras and sky as they are by now."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import torch

from recon.fit.fit import Fit
from recon.fit.inpaint import background
from recon.fit.model import MODEL
from recon.log import Log, Track
from recon.start import Start
from recon.views.skies import seen_sky
from scenes.asset import Actor, Asset
from scenes.camera import DARKEST, RigCamera
from scenes.gaussians import Placed
from scenes.scene import Scene
from scenes.sky import Sky, linear_from_srgb
from scenes.space_order import space_order


def assemble(fit: Fit, start: Start, log: Log, extra: dict | None = None) -> Scene:
    """The scene that a fit's present state stands for, on the host."""
    movers = [g.detach().to("cpu") for g in fit.splats.groups(fit.sh_count())[1:]]
    rig = {}
    for c, name in enumerate(fit.frames.names):
        mount, times = fit.motion.mounted(c, [v.time_us for v in fit.frames.views if v.camera == c])
        r = start.rig[name]
        gains = [v.gain.cpu() for v in fit.frames.views if v.camera == c and v.gain is not None]
        exposure = fit.exposures[c].detach().cpu().clone()
        each, flat_field = torch.stack(gains) if gains else None, fit.flat_fields[c].found()
        rig[name] = RigCamera(r.lens, r.width, r.height, mount, exposure, times, gains=each, flat_field=flat_field)
    share = {k: log.meta[k] for k in ("licence", "attribution", "source") if k in log.meta}
    actors = []
    for i, (track, gaussians) in enumerate(zip(start.tracks, movers, strict=True)):
        trajectory = fit.motion.trajectory(i)
        meta = {**share, "track": track.name}
        deformation = fit.limbs.of[i + 1].deformation() if i + 1 in fit.limbs.of else None
        asset = Asset(gaussians, torch.from_numpy(track.size), track.label, MODEL, meta)
        actors.append(Actor(asset, trajectory, track.name, deformation))
    parked = [
        {"track": t.name, "label": t.label, "size": t.size.tolist(), "world_from_box": middle_pose(t).tolist()}
        for t in log.tracks
        if not t.moving and t.name.startswith("veh")
    ]
    sky = Sky(linear_from_srgb(fit.sky.detach().cpu().clamp(0, brightest(rig.values()))))
    splats = background(fit)
    street = Placed(splats.select(space_order(splats.means)), torch.eye(4, dtype=torch.float64))
    found = {"movers": "found in pictures"} if actors and not log.tracks else {}
    meta = {**log.meta, **found, "parked": parked, **(extra or {})}
    scene = Scene(street, tuple(actors), sky, fit.motion.path(), rig, MODEL, start.ground, meta)
    return replace(scene, sky=seen_sky(scene.to(fit.device), fit.openings.hidden))


def brightest(rig: Iterable[RigCamera]) -> float:
    """The brightest colour of a scene, in the first camera's exposure: white in the darkest picture that any camera took, as what is
    brighter is clipped in all of them."""
    most = 1.0
    for camera in rig:
        gain, offset = camera.exposure[:, :3].sum(1), camera.exposure[:, 3]
        frames = torch.ones(1, 3) if camera.gains is None else camera.gains
        most = max(most, float(((1 / frames - offset) / gain.clamp_min(DARKEST)).max()))
    return most


def middle_pose(track: Track) -> torch.Tensor:
    """A standing box's pose: that of its middle observation."""
    return track.world_from_box[len(track.world_from_box) // 2]
