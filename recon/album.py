"""The fit's photos as the finished scene's cameras would have taken them, kept beside it (`render/album.py`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import torch
from torch.nn import functional as F

from recon.evaluation.report import readout_ends
from recon.fit.shutter import readout_shift
from recon.log import LogCamera
from recon.views.frames import Frames
from render import render_frame
from render.album import keep_photos
from render.rays import camera_rays
from scenes.camera import Camera, RigCamera
from scenes.poses import inverse
from scenes.scene import Scene
from scenes.trajectory import Trajectory

FAR = 1000.0
"""Metres at which the sky is taken to be."""


def keep_album(scene: Scene, frames: Frames, rig: dict[str, RigCamera], folder: Path, report: Callable[[], None] = lambda: None) -> None:
    """Keep the photos that a scene was fitted to in its folder; never those that were held out, which its quality is measured on.

    rig: the log's cameras, which say how the photos' rows were read. `report` is called after each photo.
    """

    def photos() -> Iterator[tuple[str, int, torch.Tensor]]:
        for c, name in enumerate(frames.names):
            mine = [v for v in frames.views if v.camera == c]
            for view, time_us in zip(mine, scene.frame_times(name).tolist(), strict=True):
                if not view.held_out:
                    camera = scene.camera(name, time_us)
                    yield name, time_us, without_ego(scene, camera, at_once(scene, camera, rig[name], view.image.float() / 255), view.ego)
                    report()

    keep_photos(folder, photos())


@torch.no_grad()
def without_ego(scene: Scene, camera: Camera, photo: torch.Tensor, ego: torch.Tensor | None) -> torch.Tensor:
    """A photo `[H, W, 3]` with what the scene shows where it shows the recording car itself (`ego` bool `[H, W]`)."""
    if ego is None:
        return photo
    rgb = render_frame(scene, camera).rgb
    assert rgb is not None
    return torch.where(ego[..., None], rgb.cpu().clamp(0, 1), photo)


@torch.no_grad()
def at_once(scene: Scene, camera: Camera, rig: RigCamera | LogCamera, photo: torch.Tensor) -> torch.Tensor:
    """A photo `[H, W, 3]` whose rows `rig`'s shutter read one after the other, as `camera` takes it at one go: each pixel looks where the
    surface that it shows was when its row was read. As it is where the shutter is global."""
    if not rig.readout_us:
        return photo
    (first, last), backs = readout_ends(scene, camera, rig)
    frame = render_frame(scene, camera, ("depth", "instance"))
    assert frame.depth is not None and frame.instance is not None
    depth, instance = frame.depth.cpu().flatten(), frame.instance.cpu().flatten()
    sky = depth.isinf() | (instance < 0)
    points = camera_rays(camera).reshape(-1, 3) * torch.where(sky, FAR, depth)[:, None]

    def as_seen(some: torch.Tensor, still: torch.Tensor, path: Trajectory | None) -> torch.Tensor:
        """Points of one instance where they were when their row was read."""
        poses = [still if path is None else path.near(t) for t in (first, last)]
        local = inverse(camera.world_from_cam) @ still
        back = inverse(local).float()
        at = some @ back[:3, :3].T + back[:3, 3]
        at = at + readout_shift(at, backs[0] @ poses[0], backs[1] @ poses[1], camera, rig.shutter)
        return at @ local[:3, :3].T.float() + local[:3, 3].float()

    background, *actors = scene.placed(camera.time_us)
    moved = as_seen(points, background.world_from_local, None)
    seen = (instance > 0).nonzero()[:, 0]  # actors are few pixels, of which each is asked once
    seen = seen[instance[seen].argsort()]
    ids, counts = instance[seen].unique_consecutive(return_counts=True)
    there = {p.instance: p.world_from_local for p in actors}
    for id, mine in zip(ids.tolist(), seen.split(counts.tolist()), strict=True):
        moved[mine] = as_seen(points[mine], there[id], scene.actors[id - 1].trajectory)
    grid = camera.lens.project(moved.view(camera.height, camera.width, 3)) / torch.tensor([camera.width, camera.height]) * 2 - 1
    grid = torch.nan_to_num(grid, nan=-1.0)[None].float()
    whole = F.grid_sample(photo.permute(2, 0, 1)[None], grid, mode="bicubic", padding_mode="border", align_corners=False)
    return whole[0].permute(1, 2, 0).clamp(0, 1)
