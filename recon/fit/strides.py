"""How long somebody's strides are, by the pictures: what the legs look like returns with each."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F

from recon.fit.motion import Motion
from recon.log import Track
from recon.views.frames import Frames
from recon.views.view import View
from scenes.poses import inverse
from scenes.trajectory import Trajectory

WALKED, PEDALLED = (0.5, 1.2), (1.0, 4.5)
"""The least and the longest stride that is looked for, in parts of the height: a walker's is 0.8 (Grieve and Gear 1966), and a turn of a
bicycle's pedals goes twice to four times as far."""

CANDIDATES = 72
"""Lengths that are tried between the two."""

WAVES = 4
"""Cosine and sine of a stride's phase and of twice that, which steps follow."""

FASTEST = 1.3
"""Strides a second at most."""

SMALLEST, FEWEST = 20.0, 12
"""Pixels that somebody must be tall, and pictures of one camera that must show it, to be looked at."""

AROUND_US = 600_000
"""Half the time whose mean is taken out of what a place shows: what is slower than a stride is no walk."""

CLEAR, CHANCE = 1.25, 2.9
"""How much more than the middle candidate the best must explain, and how much more than waves do of noise, to be believed; and it must
not be at an end. Walkers of the tests come to 1.4 to 2.7 and 3.4 to 4.4, one of drive 002, behind cars and a hedge most of the time, to 1.7
and 3.0, and who goes with stiff legs to 1.2 to 2.0 and 1.7 to 2.8."""

GRID = (10, 12)
"""Columns and rows of the places that are looked at, on a metre across and the lower `LEGS` of the height."""

LEGS = 0.55


def gone(path: Trajectory, times_us: torch.Tensor) -> torch.Tensor:
    """Metres `[T - 1]` gone between rising times."""
    return torch.stack([path.near(int(t))[:3, 3] for t in times_us]).diff(dim=0).norm(dim=1)


def phase(metres: torch.Tensor, times_us: torch.Tensor, stride: float) -> torch.Tensor:
    """Phase `[T]` in radians of strides of a length in metres, by the metres gone between times, and by `FASTEST` at most."""
    strides = torch.minimum(metres / stride, FASTEST * 1e-6 * times_us.diff().double())
    return 2 * math.pi * torch.cat([strides.new_zeros(1), strides.cumsum(0)])


def waves(turns: torch.Tensor, count: int) -> torch.Tensor:
    """Cosine and sine `[T, count]` of a phase `[T]` and its multiples."""
    return torch.stack([wave(k * turns) for k in range(1, (count + 1) // 2 + 1) for wave in (torch.cos, torch.sin)], 1)[:, :count]


@torch.no_grad()
def stride_of(track: Track, frames: Frames, motion: Motion) -> float | None:
    """A stride's length in metres: of `CANDIDATES` the one whose waves explain most of what changes where the legs are; None where no
    pictures show them or none stands out. A least-squares periodogram (Lomb 1976) over the metres gone, of all places together."""
    path, (least, longest) = track.trajectory(), WALKED if track.label == "pedestrian" else PEDALLED
    strides = float(track.size[2]) * torch.logspace(math.log10(least), math.log10(longest), CANDIDATES, dtype=torch.float64)
    explained, chance = torch.zeros(CANDIDATES, dtype=torch.float64), 0.0
    for camera in range(len(frames.names)):
        shown = [(v.time_us, p) for v in frames.of(camera) if (p := _legs(v, track, path, motion)) is not None]
        if len(shown) < FEWEST:
            continue
        times, pictures = torch.tensor([t for t, _ in shown]), torch.stack([p for _, p in shown]).double()
        near = ((times[:, None] - times).abs() <= AROUND_US).double()
        without_mean = torch.eye(len(times), dtype=torch.float64) - near / near.sum(1, keepdim=True)
        changes, metres = without_mean @ pictures, gone(path, times)
        chance += WAVES / len(times) * float(changes.square().sum())
        for i, stride in enumerate(strides.tolist()):
            basis, _ = torch.linalg.qr(without_mean @ waves(phase(metres, times, stride), WAVES))
            explained[i] += (basis.T @ changes).square().sum()
    best = int(explained.argmax())
    inside = CANDIDATES // 20 < best < CANDIDATES - 1 - CANDIDATES // 20
    believed = inside and float(explained[best]) > max(CLEAR * float(explained.median()), CHANCE * chance)
    return float(strides[best]) if believed else None


def _legs(view: View, track: Track, path: Trajectory, motion: Motion) -> torch.Tensor | None:
    """Colours `[GRID * 3]` of a view on an upright plane through the box that faces the camera; None where it does not show them all."""
    if not path.covers(view.time_us):
        return None
    camera = motion.camera(view)
    cam_from_box = inverse(camera.world_from_cam) @ path.at(view.time_us)
    eye = inverse(cam_from_box)[:2, 3]
    away = float(eye.norm())
    tall = float(camera.lens.focal()[1]) * float(track.size[2]) / away
    if away < 1 or float(cam_from_box[2, 3]) < 0.5 or tall < SMALLEST:
        return None
    across = torch.tensor([-float(eye[1]), float(eye[0]), 0.0], dtype=torch.float64) / away
    u, v = torch.linspace(-0.5, 0.5, GRID[0]).double(), torch.linspace(0, LEGS * float(track.size[2]), GRID[1]).double()
    points = u[None, :, None] * across + v[:, None, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    pixels = camera.lens.project(points.reshape(-1, 3) @ cam_from_box[:3, :3].T + cam_from_box[:3, 3])
    places = 2 * pixels / torch.tensor([camera.width, camera.height]) - 1
    if not (places.abs() < 1).all():
        return None
    image = view.image.permute(2, 0, 1)[None].float()
    return F.grid_sample(image, places.float().view(1, *reversed(GRID), 2), align_corners=False).flatten()
