"""How far away things are that lidar did not reach: at the right depth, other pictures show the same there (plane sweep, Collins 1996)."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F

from recon.views.view import View
from scenes.camera import Camera
from scenes.poses import inverse

FARTHER = (1.0, 1.4, 2.0, 2.8, 4.0, 5.6, 8.0, 16.0, 32.0)
"""Times the first guess of a depth that is tried."""

FARTHEST = 2000.0
"""Metres: beyond, nothing on a drive moves by a pixel."""

BETTER = 0.85
"""Part of the first guess's dissimilarity that another depth must fall below, or the guess stands: sky and walls look alike anywhere."""

PATCH = 5
"""Samples along a side of the patch that is compared."""

BASELINES = (-20.0, -8.0, 8.0, 20.0)
"""Metres along the way from the picture to those that it is compared with."""


def companions(view: View, views: list[View], places: np.ndarray) -> list[View]:
    """The views of the same camera that stand about `BASELINES` metres along the way from a view, where there are some.

    places: metres along the way of each of `views`.
    """
    here = places[next(i for i, v in enumerate(views) if v is view)]
    nearest = [(int(np.abs(places - here - b).argmin()), b) for b in BASELINES]
    return [views[i] for i in dict.fromkeys(i for i, b in nearest if abs(places[i] - here - b) < abs(b) / 2)]


def swept_depth(
    pixels: torch.Tensor, guess: np.ndarray, spacing: float, view: View, camera: Camera, others: list[tuple[View, Camera]]
) -> np.ndarray:
    """Depths z `[N]` at pixels `[N, 2]` of a view: `guess`, or one of `FARTHER` times it at which the patch around the pixel, its samples
    `spacing` pixels apart, looks more as `others` show it."""
    if not others or not len(pixels):
        return guess
    offsets = (torch.arange(PATCH, dtype=torch.float64) - PATCH // 2) * spacing
    patch = torch.stack(torch.meshgrid(offsets, offsets, indexing="xy"), -1).reshape(-1, 2)
    at = pixels[:, None] + patch
    own = _shown(view, at, camera)[0]
    rays = camera.lens.unproject(at)
    first = torch.from_numpy(guess)
    best, cost, limit = first, torch.full_like(first, torch.inf), torch.full_like(first, torch.inf)
    for times in FARTHER:
        z = (first * times).clamp_max(FARTHEST)
        unlike = _unlikeness(own, rays * z[:, None, None], camera, others)
        if times == 1.0:
            cost, limit = unlike, BETTER * unlike
            continue
        better = (unlike < cost) & (unlike < limit)
        best, cost = torch.where(better, z, best), torch.where(better, unlike, cost)
    return best.numpy()


def _unlikeness(own: torch.Tensor, local: torch.Tensor, camera: Camera, others: list[tuple[View, Camera]]) -> torch.Tensor:
    """Mean difference `[N]` of patches `[N, P, 3]` to what the others show at camera points `[N, P, 3]`; inf where none shows them."""
    total, count = torch.zeros(len(own)), torch.zeros(len(own))
    for view, other in others:
        motion = inverse(other.world_from_cam) @ camera.world_from_cam
        there = local @ motion[:3, :3].T + motion[:3, 3]
        shown, inside = _shown(view, other.lens.project(there), other)
        seen = (inside & (there[..., 2] > 0.5)).all(1)
        # exposure and shade may differ: a patch's mean says less than its pattern
        difference = (shown - own).float()
        mean = difference.mean(1, keepdim=True)
        error = (difference - mean).abs().mean((1, 2)) + 0.3 * mean.abs().mean((1, 2))
        total += torch.where(seen, error, 0.0)
        count += seen
    return torch.where(count > 0, total / count.clamp_min(1), torch.inf).double()


def _shown(view: View, pixels: torch.Tensor, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Colours 0..255 `[N, P, 3]` of a view at pixels `[N, P, 2]`, and whether they lie in it `[N, P]`."""
    size = torch.tensor([camera.width, camera.height], dtype=torch.float64)
    grid = (2 * pixels / size - 1).float().nan_to_num(nan=9.0).clamp(-9, 9)
    image = view.image.permute(2, 0, 1)[None].float()
    found = F.grid_sample(image, grid[None], mode="bilinear", padding_mode="border", align_corners=False)[0]
    return found.permute(1, 2, 0), ((pixels > 0) & (pixels < size)).all(-1)
