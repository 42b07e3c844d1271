"""How good a reconstruction is: held-out frames rendered from the finished scene and compared with the recording."""

from __future__ import annotations

from dataclasses import replace

import torch

from recon.fit.shutter import as_read
from recon.log import LogCamera
from recon.views.frames import Frames
from recon.views.view import View
from render import render_frame
from render.compare import psnr, ssim
from scenes.camera import Camera, RigCamera
from scenes.gaussians import Gaussians
from scenes.poses import inverse
from scenes.scene import Scene

DRIVING = 0.5
"""Metres a second above which the car counts as driving: while it stands, nearly the same picture has been trained on."""

EQUAL_DB = 100.0
"""PSNR that is reported of equal pictures: JSON, which a scene keeps it in, has no infinity."""


def held_out_table(scene: Scene, frames: Frames, rig: dict[str, RigCamera]) -> list[dict]:
    """A row a camera, all held-out frames and those while driving: PSNR and SSIM of the scene and of the mean training image.

    rig: the log's cameras, which say how the photos' rows were read; the scene's take all at once, and are drawn here as those were.
    What shows the recording car itself does not count.

    Rows: camera, frames ("0-72" or "driving"), count, psnr, ssim, mean_psnr, mean_ssim; figures are means over frames.
    """
    rows = []
    for c, name in enumerate(frames.names):
        training = frames.of(c)
        mean = torch.stack([v.image for v in training]).sum(0, dtype=torch.int32).float() / (255 * len(training))
        began = dict(zip([v.index for v in frames.views if v.camera == c], scene.frame_times(name).tolist(), strict=True))
        scored: list[tuple] = []
        for view in frames.of(c, held_out=True):
            recorded = view.image.float() / 255
            with torch.no_grad():
                camera = scene.camera(name, began[view.index])
                rgb = render_frame(read_out(scene, camera, rig[name]), camera).rgb
            assert rgb is not None
            rgb, street = rgb.cpu(), None if view.ego is None else ~view.ego
            figures = [min(metric(shown, recorded, street), EQUAL_DB) for shown in (rgb, mean) for metric in (psnr, ssim)]
            scored.append((view, *figures))
        rows += [_row(name, "all", scored), _row(name, "driving", [s for s in scored if _driving(scene, s[0])])]
    return [r for r in rows if r is not None]


def read_out(scene: Scene, camera: Camera, rig: RigCamera) -> Scene:
    """The scene that a global shutter sees as `rig`'s shutter sees this one, the middle of its readout being the camera's moment."""
    if not rig.readout_us:
        return scene
    (first, last), backs = readout_ends(scene, camera, rig)

    def moved(splats: Gaussians, poses: list[torch.Tensor]) -> Gaussians:
        return as_read(splats, backs[0] @ poses[0], backs[1] @ poses[1], camera, rig.shutter)

    still = scene.background.world_from_local
    actors = [
        replace(a, asset=replace(a.asset, gaussians=moved(a.asset.gaussians, [a.trajectory.near(t) for t in (first, last)])))
        if a.trajectory.covers(camera.time_us)
        else a
        for a in scene.actors
    ]
    background = replace(scene.background, gaussians=moved(scene.background.gaussians, [still, still]))
    return replace(scene, background=background, actors=tuple(actors))


def readout_ends(scene: Scene, camera: Camera, rig: RigCamera | LogCamera) -> tuple[tuple[int, int], tuple[torch.Tensor, torch.Tensor]]:
    """When the first and the last row (column) are read if the middle one is at `camera`'s moment, and cam_from_world `[4, 4]` then."""
    first, last = (camera.time_us + sign * rig.readout_us // 2 for sign in (-1, 1))
    mount = inverse(scene.ego.at(camera.time_us)) @ camera.world_from_cam
    return (first, last), (inverse(scene.ego.near(first) @ mount), inverse(scene.ego.near(last) @ mount))


def _driving(scene: Scene, view: View) -> bool:
    before, after = (max(scene.ego.span_us()[0], view.time_us - 50_000), min(scene.ego.span_us()[1], view.time_us + 50_000))
    moved = (scene.ego.at(after) - scene.ego.at(before))[:3, 3].norm()
    return float(moved) / max((after - before) * 1e-6, 1e-6) > DRIVING


def _row(name: str, which: str, scored: list[tuple]) -> dict | None:
    if not scored:
        return None
    figures = torch.tensor([s[1:] for s in scored], dtype=torch.float64).mean(0).tolist()
    row = {"camera": name, "which": which, "frames": [s[0].index for s in scored]}
    return row | dict(zip(("psnr", "ssim", "mean_psnr", "mean_ssim"), (round(f, 4) for f in figures), strict=True))


def table_text(rows: list[dict]) -> str:
    """The rows for people."""
    lines = [f"{'held out':<34} {'frames':>7} {'PSNR':>7} {'SSIM':>7}   mean image: {'PSNR':>6} {'SSIM':>7}"]
    for r in rows:
        where = f"{r['camera']}, {r['which']}"
        figures = f"{r['psnr']:>7.2f} {r['ssim']:>7.3f} {r['mean_psnr']:>20.2f} {r['mean_ssim']:>7.3f}"
        lines.append(f"{where:<34} {len(r['frames']):>7} {figures}")
    return "\n".join(lines)
