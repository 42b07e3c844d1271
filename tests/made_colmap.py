"""The made-up street as a COLMAP workspace: rendered pictures and a text model, in a world of its own scale and attitude."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from render import render_frame
from scenes.poses import inverse, pose_from, quat_from_matrix, translation

UNIT = 0.25
"""Model units a metre."""

TURN = pose_from([0.6, 0.3, -0.5, 0.5], [3.0, -2.0, 5.0])
"""Of the model's world against the street's."""

HEIGHT = 1.5
"""Metres that the street's cameras stand above its ground."""


def pictures_along(street, name: str = "front_camera", count: int = 12, step: float = 0.5) -> list:
    """Cameras of a walk along the street, swaying: `step` metres apart, a little left and right."""
    cameras = []
    for i in range(count):
        sway = pose_from([1.0, 0.0, 0.0, 0.03 * (-1) ** i], [0.0, 0.15 * (-1) ** i, 0.0])
        cameras.append(street.rig[name].at(translation(step * i, 0, 0) @ sway, 0))
    return cameras


def write_colmap(folder: Path, street, cameras: dict[str, list], gains=None, width=96, height=54, points=60) -> Path:
    """Write a workspace with pictures of `street` (its movers left out) and return it.

    cameras: by folder of pictures, "" for none; gains: of every picture of a folder; points: found in each picture.
    """
    still = replace(street, actors=())
    generator = np.random.default_rng(0)
    shots, lenses = [], []
    for c, (sub, views) in enumerate(cameras.items(), 1):
        for i, view in enumerate(views):
            camera = view.resized(width, height)
            with torch.no_grad():
                frame = render_frame(still, camera, ("rgb", "depth"))
            name = Path(sub) / f"{i:03d}.png"
            picture = frame.rgb * (1.0 if gains is None else gains[i])
            (folder / "images" / name).parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray((picture.clamp(0, 1) * 255).round().byte().numpy()).save(folder / "images" / name)
            shots.append((c, str(name), camera, frame.depth.double()))
        lens = camera.lens
        lenses.append(f"{c} PINHOLE {width} {height} {lens.fx} {lens.fy} {lens.cx} {lens.cy}")

    found = []
    for _, _, camera, depth in shots:
        rows, columns = np.nonzero(np.isfinite(depth.numpy()))
        chosen = generator.choice(len(rows), points, replace=False)
        pixels = torch.from_numpy(np.stack([columns[chosen], rows[chosen]], 1) + 0.5)
        local = camera.lens.unproject(pixels) * depth[rows[chosen], columns[chosen], None]
        eye = camera.world_from_cam[:3, 3]
        rays = local @ camera.world_from_cam[:3, :3].T
        # the road's splats are drawn before their middles, by a quarter of the depth at this slant; what is low lies on the road
        onto = torch.where((rays[:, 2] + eye[2] < 0.6) & (rays[:, 2] < 0), -eye[2] / rays[:, 2], torch.ones(len(rays)))
        found.append(eye + rays * onto[:, None])
    world = torch.cat(found)
    tracks: list[list[str]] = [[] for _ in world]
    lines = []
    for number, (c, name, camera, depth) in enumerate(shots, 1):
        back = inverse(camera.world_from_cam)
        local = world @ back[:3, :3].T + back[:3, 3]
        pixels = camera.lens.project(local)
        inside = (local[:, 2] > 0.5) & (pixels >= 0).all(1) & (pixels < torch.tensor([width, height])).all(1)
        observed = []
        for p in inside.nonzero()[:, 0].tolist():
            u, v = pixels[p].tolist()
            if 0.6 < float(depth[int(v), int(u)] / local[p, 2]) < 1.1:
                tracks[p].append(f"{number} {len(observed)}")
                observed.append(f"{u:.6f} {v:.6f} {p + 1}")
        pose = inverse(in_model(camera.world_from_cam))
        lines += [f"{number} {_text(quat_from_matrix(pose[:3, :3]))} {_text(pose[:3, 3])} {c} {name}", " ".join(observed)]
    placed = world @ (UNIT * TURN[:3, :3].T) + TURN[:3, 3]
    rows = [f"{p + 1} {_text(placed[p])} 128 128 128 0.5 {' '.join(track)}" for p, track in enumerate(tracks) if track]
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    for part, text in (("cameras", lenses), ("images", lines), ("points3D", rows)):
        (model / f"{part}.txt").write_text("\n".join(text) + "\n")
    return folder


def _text(values: torch.Tensor) -> str:
    return " ".join(f"{v:.17g}" for v in values.tolist())


def in_model(world_from_cam: torch.Tensor) -> torch.Tensor:
    """A pose of the street in the model's world."""
    pose = TURN @ world_from_cam
    pose[:3, 3] = UNIT * (TURN[:3, :3] @ world_from_cam[:3, 3]) + TURN[:3, 3]
    return pose


def relative(poses: torch.Tensor) -> torch.Tensor:
    """Poses as the first one sees them: what no choice of world changes."""
    return inverse(poses[:1]) @ poses
