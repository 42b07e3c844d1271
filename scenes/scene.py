"""A reconstructed drive."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import torch

from scenes.asset import Actor
from scenes.camera import Camera, RigCamera, followed
from scenes.deformation import Lattice
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.ground import Ground
from scenes.harmonics import brighter
from scenes.lenses import Orthographic
from scenes.names import unknown
from scenes.sky import Sky
from scenes.trajectory import Trajectory, all_at

ALIKE = 0.1
"""Part by which angles of view may differ that are taken for the same."""


@dataclass(frozen=True)
class Scene:
    """Background, actors, sky, ground, and the ego body with its cameras. Instance ids: background 0, `actors[i]` i + 1.

    `meta` is json-like: name, source, licence, attribution, geodetic origin, what the body frame is, ...
    own: further cameras on the body (`scenes/own_camera.py`), which recorded nothing; no file keeps them.
    """

    background: Placed
    actors: tuple[Actor, ...]
    sky: Sky | None
    ego: Trajectory
    rig: dict[str, RigCamera]
    model: SplatModel = field(default_factory=SplatModel)
    ground: Ground | None = None
    meta: dict = field(default_factory=dict)
    own: dict[str, RigCamera] = field(default_factory=dict)

    def __post_init__(self):
        object.__setattr__(self, "actors", tuple(self.actors))
        tracks = [a.track for a in self.actors]
        if len(set(tracks)) != len(tracks):
            raise ValueError(f"actor tracks must differ, but {next(t for t in tracks if tracks.count(t) > 1)!r} stands twice")

    def to(self, device) -> Scene:
        """The same scene with its splats on a device; poses, lenses, sky and ground stay where they are."""
        background = replace(self.background, gaussians=self.background.gaussians.to(device))
        actors = tuple(
            replace(a, asset=replace(a.asset, gaussians=a.asset.gaussians.to(device)), deformation=d and d.to(device))
            for a in self.actors
            for d in [a.deformation]
        )
        return replace(self, background=background, actors=actors)

    def rig_camera(self, name: str) -> RigCamera:
        """The camera of that name, of one's own or the rig's; ValueError naming the nearest where there is none."""
        if name in self.own:
            return self.own[name]
        if name not in self.rig:
            raise ValueError(unknown("camera", name, str(self.meta.get("path", self.meta.get("name", "the scene"))), self.rig))
        return self.rig[name]

    def camera(self, name: str, time_us: int, ego: Trajectory | None = None) -> Camera:
        """The named camera at a time, on the recorded path or on another one, as `ego.shifted(lateral=2)`."""
        return self.rig_camera(name).along(ego or self.ego, time_us)

    def model_for(self, camera: Camera) -> SplatModel:
        """The splat model for a camera's pictures, scaled (`SplatModel.at_scale`) by its focal length in pixels over that of the rig's
        camera with the most similar field of view, or over the camera's `trained_focal`. Not scaled for orthographic cameras, nor up for
        those of another field of view without a `trained_focal`, whose splats other cameras were fitted to from nearer by."""
        fitted = [c for c in self.rig.values() if c.fitted and not isinstance(c.lens, Orthographic)]
        if not fitted or isinstance(camera.lens, Orthographic):
            return self.model
        if camera.trained_focal is not None:
            return self.model.at_scale(max(camera.lens.focal()) / camera.trained_focal)
        focal, narrow = max(camera.lens.focal()), max(camera.lens.focal()) / camera.width
        angle, same = min(((abs(math.log(max(c.lens.focal()) / c.width / narrow)), c) for c in fitted), key=lambda pair: pair[0])
        scale = float(focal / max(same.lens.focal()))
        return self.model.at_scale(scale if angle < ALIKE else min(scale, 1.0))

    def frame_times(self, name: str) -> torch.Tensor:
        """When the named camera took its frames, int64 `[F]`; the body's times where the log does not say."""
        times = self.rig_camera(name).times_us
        return times if len(times) else self.ego.times_us

    def followed(self, time_us: int) -> torch.Tensor | None:
        """Exposure gain `[3]` of the cameras at a time, relative to their mean; None where it does not vary."""
        return followed([(c.times_us, c.gains) for c in self.rig.values()], time_us)

    def anew(self) -> list[int]:
        """Instance ids of the inserted and edited actors."""
        return [i + 1 for i, actor in enumerate(self.actors) if actor.anew]

    def placed(self, time_us: int, readout_us: int = 0) -> list[Placed]:
        """Background and the actors that exist at a time, each at its pose and under its instance id; with the pose to which it
        moves while an image is read out, where that takes `readout_us`. What deforms stands as in the middle of it; recorded actors are
        as bright as the cameras' exposures say that their light is (`followed`)."""
        here = [(i, a) for i, a in enumerate(self.actors) if a.trajectory.covers(time_us)]
        poses = all_at([a.trajectory for _, a in here], time_us)
        gain = self.followed(time_us)
        splats = [dimmed(a.asset.gaussians, gain) if a.recorded else a.asset.gaussians for _, a in here]
        actors = [
            Placed(g, pose, end_pose(a, time_us, readout_us), instance=i + 1) for g, (i, a), pose in zip(splats, here, poses, strict=True)
        ]
        middle = time_us + readout_us // 2
        bent = [p if a.deformation is None else bend(p, a.deformation.at(middle)) for (_, a), p in zip(here, actors, strict=True)]
        return [self.background, *bent]


def dimmed(splats: Gaussians, gain: torch.Tensor | None) -> Gaussians:
    """Splats so much less bright as cameras were exposed more, by a gain `[3]`; as they are where that is None."""
    return splats if gain is None else replace(splats, sh=brighter(splats.sh, 1 / gain.to(splats.sh)))


def bend(placed: Placed, lattice: Lattice) -> Placed:
    """What is placed with its splats moved by a lattice; how they are turned and shaped stays."""
    splats = placed.gaussians
    return replace(placed, gaussians=replace(splats, means=splats.means + lattice.at(splats.means)), lattice=lattice)


def end_pose(actor: Actor, time_us: int, readout_us: int) -> torch.Tensor | None:
    """`world_from_asset` `[4, 4]` as an image is read out at last that takes `readout_us`; None where the actor stands still meanwhile."""
    moves = readout_us != 0 and len(actor.trajectory) > 1
    return actor.trajectory.near(time_us + readout_us) if moves else None
