"""What a camera cannot see is left out before anything is projected: whole instances, and clusters of a large one.

A cluster is a run of splats that lie side by side in memory; its bound is a sphere around their means and their ellipsoids. Bounds are
made once for a set of splats and kept beside it, so that the cameras of a rig and the frames of a clip share them. What remains is
projected in the same order: the picture is the same bits. Splats in no spatial order have clusters as large as the scene, of which none is
left out; then this costs the test of a few spheres. A GPU, which waits for the host, has projected `FEW` splats sooner than that.

Only for what is not differentiated: a splat that is not drawn would still need its gradient of zeros.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import torch

from render.kept import kept_beside
from render.kernels.types import ITEM, REACH
from render.projection import moves
from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.lenses import OpenCV, Pinhole
from scenes.lenses.box import view_box

CLUSTER = 1024
"""Splats of a cluster: a whole number of items."""

FEW = 1_000_000
"""Splats that a GPU projects and sorts before the host has found out which it need not."""


def in_sight(placed: Sequence[Placed], camera: Camera, model: SplatModel) -> list[np.ndarray | None]:
    """bool `[items]` for each of `placed`: which of its runs of ITEM splats `camera` may see; None where all are drawn without a look."""
    few = placed[0].gaussians.device.type == "cuda" and sum(len(p.gaussians) for p in placed) < FEW
    if few or not isinstance(camera.lens, Pinhole | OpenCV) or moves(camera, placed):
        return [None] * len(placed)
    there = [p for p in placed if len(p.gaussians)]
    seen = iter(_seen(there, camera, view_sides(camera, model)))
    return [_of_items(next(seen), len(p.gaussians)) if len(p.gaussians) else None for p in placed]


def _of_items(clusters: np.ndarray, splats: int) -> np.ndarray:
    return clusters.repeat(CLUSTER // ITEM)[: -(-splats // ITEM)]


def splats_in_sight(placed: Sequence[Placed], seen: Sequence[np.ndarray | None]) -> torch.Tensor:
    """int64 `[M]`, of all splats of `placed`, one after the other, those that are projected."""
    sizes = [len(p.gaussians) for p in placed]
    shown = [np.ones(n, dtype=bool) if s is None else s.repeat(ITEM)[:n] for s, n in zip(seen, sizes, strict=True)]
    return torch.from_numpy(np.flatnonzero(np.concatenate(shown))).to(placed[0].gaussians.device)


def differentiated(placed: Sequence[Placed], camera: Camera, features: torch.Tensor | Sequence[torch.Tensor] | None = None) -> bool:
    """Whether autograd will ask for a gradient of anything here."""
    if not torch.is_grad_enabled():
        return False
    tensors = [t for p in placed for t in (p.world_from_local, p.world_from_local_end, *p.gaussians.tensors().values())]
    tensors += [] if features is None else [features] if isinstance(features, torch.Tensor) else features
    tensors += [camera.world_from_cam, camera.world_from_cam_end, camera.lens.params()]
    return any(t is not None and t.requires_grad for t in tensors)


def view_sides(camera: Camera, model: SplatModel) -> torch.Tensor:
    """Unit normals `[5, 3]`, out of the view, of the planes through the eye that bound it, and of the plane of the camera."""
    return _sides(camera.lens.key(), camera.width, camera.height, 4 * math.sqrt(model.widening) + 1)


@lru_cache(maxsize=64)
def _sides(lens: tuple, width: int, height: int, margin: float) -> torch.Tensor:
    left, right, top, bottom = view_box(lens[0](*lens[1:]), width, height, margin)
    normals = [[1, 0, -right], [-1, 0, left], [0, 1, -bottom], [0, -1, top], [0, 0, -1]]
    return torch.nn.functional.normalize(torch.tensor(normals, dtype=torch.float64), dim=1)


def _seen(placed: Sequence[Placed], camera: Camera, sides: torch.Tensor) -> list[np.ndarray]:
    """For each cluster of each instance, whether it lies beyond none of the sides."""
    if not placed:
        return []
    centres, radii = zip(*(bounds(p.gaussians) for p in placed), strict=True)
    sizes = [len(r) for r in radii]
    eye, poses = (pose.detach().cpu().numpy() for pose in (camera.world_from_cam, torch.stack([p.world_from_local for p in placed])))
    turns, places = eye[:3, :3].T @ poses[:, :3, :3], (poses[:, :3, 3] - eye[:3, 3]) @ eye[:3, :3]
    there = np.einsum("cij,cj->ci", turns.repeat(sizes, 0), np.concatenate(centres)) + places.repeat(sizes, 0)
    # a bound that is not a number is not beyond anything
    beyond = (there @ sides.numpy().T > np.concatenate(radii)[:, None]).any(1)
    return np.split(~beyond, np.cumsum(sizes)[:-1])


def bounds(g: Gaussians) -> tuple[np.ndarray, np.ndarray]:
    """Centres `[C, 3]` and radii `[C]`, float64, of spheres around the clusters' ellipsoids of 3.33 sigma; kept until the splats change."""
    return _spheres(g.means, g.log_scales, CLUSTER)


@kept_beside
def _spheres(means: torch.Tensor, log_scales: torch.Tensor, cluster: int) -> tuple[np.ndarray, np.ndarray]:
    spare = -len(means) % cluster  # the last cluster is filled up with its last splat
    means, reach = means.detach(), float(REACH) * log_scales.detach().amax(1).exp()
    means = torch.cat([means, means[-1:].expand(spare, 3)]).view(-1, cluster, 3)
    reach = torch.cat([reach, reach[-1:].expand(spare)]).view(-1, cluster)
    centres = 0.5 * (means.amin(1) + means.amax(1))
    radii = ((means - centres[:, None]).norm(dim=2) + reach).amax(1)
    # float32's rounding here and in the kernels
    middles, reaches = centres.double().cpu().numpy(), radii.double().cpu().numpy()
    return middles, reaches * (1 + 1e-5) + 1e-5 * np.linalg.norm(middles, axis=1)
