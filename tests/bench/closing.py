"""Ends of vehicles that no photo shows: how like the whole vehicle its shell looks from there, hollow and closed.

    python -m tests.bench.closing FOLDER [NAME ...]

A mesh becomes splats; those that no camera on the street sees from the sides and from one end are taken away, and the other end is closed
as `assets extract` closes it. Three views of that end: how much of the silhouettes is common (intersection over union), and PSNR over the
whole vehicle's pixels, before mid-grey.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import torch

from recon.assets.closing import ENDS, hull_of_end
from recon.assets.looking import looking_at
from recon.assets.mesh_files import read_mesh
from recon.assets.mesh_splats import MODEL, splats_of_mesh
from render import Frame, rasterize
from scenes.camera import Camera
from scenes.gaussians import Gaussians
from scenes.poses import inverse

NAMES = ("hatchback", "prius_hybrid", "pickup", "fire_truck")
SEEN_FROM = (0, 35, -35, 70, -70, 90, -90)
"""Degrees from the end that is seen, and those from which the other one is looked at."""
LOOKED_AT = (180, 145, 240)
EYE, AWAY = 1.6, (6.0, 10.0, 16.0)
"""Metres above the ground and from the middle of cameras on the street."""
BEFORE = 0.06
"""Metres that a splat may lie behind what is seen and still be seen."""


def around(size: np.ndarray, degrees: float, away: float, pixels: tuple[int, int]) -> Camera:
    """A camera at an angle from the front of a box `[length, width, height]` that looks at its middle."""
    turn = math.radians(degrees)
    eye = torch.tensor([away * math.cos(turn), away * math.sin(turn), EYE], dtype=torch.float64)
    return looking_at(torch.tensor([0.0, 0.0, float(size[2]) / 2], dtype=torch.float64), eye, *pixels)


def drawn(splats: Gaussians, camera: Camera, *outputs: str) -> Frame:
    with torch.no_grad():
        frame = rasterize(splats, camera, outputs, model=MODEL)
    assert isinstance(frame, Frame)
    return frame


def seen(splats: Gaussians, cameras: list[Camera]) -> torch.Tensor:
    """Mask `[N]` of splats that one of the cameras sees."""
    found = torch.zeros(len(splats), dtype=torch.bool)
    for camera in cameras:
        depth = drawn(splats, camera, "depth").depth
        assert depth is not None
        cam_from_world = inverse(camera.world_from_cam)
        points = splats.means.double() @ cam_from_world[:3, :3].T + cam_from_world[:3, 3]
        column, row = camera.lens.project(points).floor().long().unbind(1)
        inside = (points[:, 2] > 0.1) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        shown = depth[row[inside], column[inside]]
        found[inside] |= points[inside, 2] < shown + BEFORE
    return found


def likeness(splats: Gaussians, whole: Gaussians, cameras: list[Camera]) -> tuple[float, float]:
    """Intersection over union of silhouettes, the mean, and PSNR in dB over the whole vehicle's pixels."""
    common, errors = [], []
    for camera in cameras:
        ours, theirs = (drawn(g, camera, "rgb", "alpha") for g in (splats, whole))
        assert ours.rgb is not None and ours.alpha is not None and theirs.rgb is not None and theirs.alpha is not None
        there, own = theirs.alpha > 0.5, ours.alpha > 0.5
        common.append(float((own & there).sum() / (own | there).sum()))
        error = ours.rgb + 0.5 * (1 - ours.alpha)[..., None] - theirs.rgb - 0.5 * (1 - theirs.alpha)[..., None]
        errors.append(error[there].square().mean())
    return float(np.mean(common)), float(-10 * torch.stack(errors).mean().log10())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("names", nargs="*", default=NAMES)
    asked = parser.parse_args()
    print("| mesh, end that nobody saw | silhouette, hollow | closed | PSNR, hollow | closed |\n|---|---|---|---|---|")
    for name in asked.names:
        mesh = read_mesh(asked.folder / f"{name}.glb")
        size = (mesh.vertices.max(0) - mesh.vertices.min(0)).astype(np.float64)
        whole = splats_of_mesh(mesh, 40_000)
        for end, side in ENDS.items():
            seen_end = 180 if end == "front" else 0
            shell = whole.select(seen(whole, [around(size, seen_end + d, m, (640, 480)) for d in SEEN_FROM for m in AWAY]))
            cameras = [around(size, seen_end + d, 1.6 * float(np.linalg.norm(size)), (320, 240)) for d in LOOKED_AT]
            closed = Gaussians.cat([shell, hull_of_end(shell, size, side)])
            (before, hollow), (after, full) = (likeness(g, whole, cameras) for g in (shell, closed))
            print(f"| {name}, {end} | {before:.3f} | {after:.3f} | {hollow:.2f} dB | {full:.2f} dB |", flush=True)


if __name__ == "__main__":
    main()
