"""How long somebody's strides are, by the pictures: what the legs look like returns with each."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
import torch.nn.functional as F

from recon.fit.motion import Motion
from recon.log import Track
from recon.views.frames import Frames
from recon.views.view import View
from scenes.camera import Camera
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

CLEAR, CHANCE = 1.33, 2.9
"""How much more than the middle candidate the best must explain, and how much more than waves do of noise, to be believed; and it must
not be at an end. Walkers of the tests come to 1.4 to 2.7 and 3.4 to 4.4, one of drive 002, behind cars and a hedge most of the time, to 1.7
and 3.0, and who goes with stiff legs to 1.2 to 2.2 and 1.7 to 3.3, but to one of both alone."""

GRID = (10, 12)
"""Columns and rows of the places that are looked at, on a metre across and the lower `LEGS` of the height."""

LEGS = 0.55

DIFFERS = 30.0
"""Mean levels of 255 by which something differs from what is behind it, from which on it surely is something else."""

OTHERS, GONE_US, FARTHEST = 12, 700_000, 100.0
"""Views by which it is told what is behind somebody, how long before or after they are taken, so that somebody has gone on, and metres to
the street within which they are asked."""


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


@dataclass(frozen=True)
class _Look:
    """A view of somebody's legs: where its camera is then, and points `[GRID, 3]` in the world on an upright plane through the box that
    faces it; up: the box's own `[3]`, from its base `[3]`."""

    view: View
    camera: Camera
    points: torch.Tensor
    base: torch.Tensor
    up: torch.Tensor

    def colours(self) -> torch.Tensor:
        """Colours `[GRID, 3]`, 0..255."""
        return _colours(self.view, self.camera, self.points)[0]

    def stands_out(self, others: Sequence[View], motion: Motion) -> torch.Tensor:
        """How much what is shown differs, 0..1, from the street behind it, as the median of others shows that, in the means of two by two
        places, `[GRID / 4]`; 0 where none of them shows it, and where the line of sight meets no ground."""
        eye = self.camera.world_from_cam[:3, 3]
        ways = self.points - eye
        down = -(ways @ self.up)
        depth = ((eye - self.base) @ self.up) / down.clamp_min(1e-6)
        street = eye + depth[:, None] * ways
        met = (down > 0) & ((street - eye).norm(dim=1) < FARTHEST)
        seen = []
        for other in others:
            colours, inside = _colours(other, motion.camera(other), street)
            seen.append(colours.masked_fill(~(inside & met)[:, None], torch.nan))
        behind = torch.stack(seen).nanmedian(0).values if seen else torch.full_like(self.colours(), torch.nan)
        differs = ((self.colours() - behind).abs().mean(1) / DIFFERS).clamp_max(1).nan_to_num(0)
        return F.avg_pool2d(differs.view(1, *reversed(GRID)), 2).flatten()


@torch.no_grad()
def stride_of(track: Track, frames: Frames, motion: Motion) -> float | None:
    """A stride's length in metres: of `CANDIDATES` the one whose waves explain most of what changes where the legs are; None where no
    pictures show them or none stands out.

    First colours are asked. Who walks before something painted, as a crossing's stripes, has those pass behind the legs; then what differs
    from the street behind it tells where these are.
    """
    path = track.trajectory()
    of_cameras = [[v for v in frames.of(c) if path.covers(v.time_us)] for c in range(len(frames.names))]
    looks = [[look for v in views if (look := _look(v, track, path, motion)) is not None] for views in of_cameras]
    looks = [some for some in looks if len(some) >= FEWEST]

    def standing_out(look: _Look) -> torch.Tensor:
        views = [v for v in frames.of(look.view.camera) if abs(v.time_us - look.view.time_us) > GONE_US]
        return look.stands_out(sorted(views, key=lambda v: abs(v.time_us - look.view.time_us))[:OTHERS], motion)

    for told in (_Look.colours, standing_out):
        shown = [(torch.tensor([k.view.time_us for k in some]), torch.stack([told(k).flatten() for k in some])) for some in looks]
        if (stride := _rhythm(shown, track)) is not None:
            return stride
    return None


def _rhythm(shown: Sequence[tuple[torch.Tensor, torch.Tensor]], track: Track) -> float | None:
    """The stride by which what is shown changes, of each camera at its times `[T]` what places show, `[T, K]`; None where none stands out.
    A least-squares periodogram (Lomb 1976) over the metres gone, of all places together."""
    path, (least, longest) = track.trajectory(), WALKED if track.label == "pedestrian" else PEDALLED
    strides = float(track.size[2]) * torch.logspace(math.log10(least), math.log10(longest), CANDIDATES, dtype=torch.float64)
    explained, chance = torch.zeros(CANDIDATES, dtype=torch.float64), 0.0
    for times, pictures in shown:
        near = ((times[:, None] - times).abs() <= AROUND_US).double()
        without_mean = torch.eye(len(times), dtype=torch.float64) - near / near.sum(1, keepdim=True)
        changes, metres = without_mean @ pictures.double(), gone(path, times)
        chance += WAVES / len(times) * float(changes.square().sum())
        for i, stride in enumerate(strides.tolist()):
            basis, _ = torch.linalg.qr(without_mean @ waves(phase(metres, times, stride), WAVES))
            explained[i] += (basis.T @ changes).square().sum()
    best = int(explained.argmax())
    inside = CANDIDATES // 20 < best < CANDIDATES - 1 - CANDIDATES // 20
    believed = inside and float(explained[best]) > max(CLEAR * float(explained.median()), CHANCE * chance)
    return float(strides[best]) if believed else None


def _look(view: View, track: Track, path: Trajectory, motion: Motion) -> _Look | None:
    """How a view sees legs, somewhere in whose time it was taken; None where it does not show them all, or they are small."""
    camera, box = motion.camera(view), path.at(view.time_us)
    cam_from_box = inverse(camera.world_from_cam) @ box
    eye = inverse(cam_from_box)[:2, 3]
    away = float(eye.norm())
    tall = float(camera.lens.focal()[1]) * float(track.size[2]) / away
    if away < 1 or float(cam_from_box[2, 3]) < 0.5 or tall < SMALLEST:
        return None
    across = torch.tensor([-float(eye[1]), float(eye[0]), 0.0], dtype=torch.float64) / away
    u, v = torch.linspace(-0.5, 0.5, GRID[0]).double(), torch.linspace(0, LEGS * float(track.size[2]), GRID[1]).double()
    points = u[None, :, None] * across + v[:, None, None] * torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    world = points.reshape(-1, 3) @ box[:3, :3].T + box[:3, 3]
    return _Look(view, camera, world, box[:3, 3], box[:3, 2]) if _colours(view, camera, world)[1].all() else None


def _colours(view: View, camera: Camera, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Colours `[N, 3]`, 0..255, of world points `[N, 3]` in a view, and whether they are before its camera and in its picture, `[N]`."""
    back = inverse(camera.world_from_cam)
    local = points @ back[:3, :3].T + back[:3, 3]
    pixels = camera.lens.project(local).nan_to_num(-1.0)
    inside = (pixels > 0).all(-1) & (pixels < torch.tensor([camera.width, camera.height])).all(-1) & (local[:, 2] > 0)
    if not inside.any():
        return torch.zeros(len(points), 3), inside
    # of a large picture the few pixels around them are enough
    (left, top), (right, bottom) = (pixels[inside].amin(0) - 1).clamp_min(0).int().tolist(), (pixels[inside].amax(0) + 2).int().tolist()
    part = view.image[top:bottom, left:right].permute(2, 0, 1)[None].float()
    places = 2 * (pixels - torch.tensor([left, top])) / torch.tensor([part.shape[3], part.shape[2]]) - 1
    shown = F.grid_sample(part, places.float().clamp(-9, 9)[None, None], align_corners=False)
    return shown[0, :, 0].T, inside
