"""What a camera cannot see is left out before anything is projected: whole instances, and clusters of a large one.

A cluster is a run of splats that lie side by side in memory; its bound is a sphere around their means and their ellipsoids. Bounds are
made once for a set of splats and kept beside it, so that the cameras of a rig and the frames of a clip share them. What remains are
slices of the same tensors, in the same order: the picture is the same bits. Splats in no spatial order have clusters as large as the
scene, of which none is left out; then this costs the test of a few spheres.

Only for what is not differentiated: a splat that is not drawn would still need its gradient of zeros.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch.utils.weak import WeakTensorKeyDictionary

from render.kernels.types import REACH
from render.projection import moves
from scenes.camera import Camera
from scenes.gaussians import Gaussians, Placed, SplatModel
from scenes.lenses import OpenCV, Pinhole
from scenes.lenses.box import view_box
from scenes.poses import inverse

CLUSTER = 1024
"""Splats of a cluster."""

MOST_RUNS = 24
"""Slices that one instance is drawn in at most: each is a launch."""

_bounds = WeakTensorKeyDictionary()  # by means: what they were made from, and the spheres


def in_sight(placed: Sequence[Placed], camera: Camera, model: SplatModel) -> list[Placed]:
    """Those of `placed`, and the parts of them, that `camera` may see: at least one, maybe empty, so that there is something to draw."""
    placed = list(placed)
    if not isinstance(camera.lens, Pinhole | OpenCV) or moves(camera, placed):
        return placed
    sides = view_sides(camera, model)
    there = [p for p in placed if len(p.gaussians)]
    seen = [part for p, beyond in zip(there, _beyond(there, camera, sides), strict=True) for part in _parts(p, beyond)]
    return seen or [replace(placed[0], gaussians=placed[0].gaussians.map(lambda t: t[:0]))]


def differentiated(placed: Sequence[Placed], camera: Camera) -> bool:
    """Whether autograd will ask for a gradient of anything here."""
    if not torch.is_grad_enabled():
        return False
    tensors = [t for p in placed for t in (p.world_from_local, p.world_from_local_end, *p.gaussians.tensors().values())]
    tensors += [camera.world_from_cam, camera.world_from_cam_end, camera.lens.params()]
    return any(t is not None and t.requires_grad for t in tensors)


def view_sides(camera: Camera, model: SplatModel) -> torch.Tensor:
    """Unit normals `[5, 3]`, out of the view, of the planes through the eye that bound it, and of the plane of the camera."""
    left, right, top, bottom = view_box(camera.lens, camera.width, camera.height, 4 * math.sqrt(model.dilation) + 1)
    normals = [[1, 0, -right], [-1, 0, left], [0, 1, -bottom], [0, -1, top], [0, 0, -1]]
    return torch.nn.functional.normalize(torch.tensor(normals, dtype=torch.float64), dim=1)


def _beyond(placed: Sequence[Placed], camera: Camera, sides: torch.Tensor) -> list[list[bool]]:
    """For each cluster of each instance, whether it lies beyond one of the sides."""
    if not placed:
        return []
    centres, radii = zip(*(bounds(p.gaussians) for p in placed), strict=True)
    sizes = torch.tensor([len(r) for r in radii])
    poses = inverse(camera.world_from_cam) @ torch.stack([p.world_from_local for p in placed])
    poses = poses.repeat_interleave(sizes, 0).to(centres[0])
    there = (poses[:, :3, :3] @ torch.cat(centres)[..., None])[..., 0] + poses[:, :3, 3]
    # a bound that is not a number is not beyond anything
    beyond = (there @ sides.T.to(there) > torch.cat(radii)[:, None]).any(1)
    return [part.tolist() for part in beyond.split(sizes.tolist())]


def _parts(p: Placed, beyond: list[bool]) -> list[Placed]:
    runs = _runs([not b for b in beyond])
    if runs == [(0, len(beyond))]:
        return [p]
    return [replace(p, gaussians=p.gaussians.map(lambda t, a=a, b=b: t[a * CLUSTER : b * CLUSTER])) for a, b in runs]


def _runs(seen: list[bool]) -> list[tuple[int, int]]:
    """First and one past the last of the runs of seen clusters; the narrowest gaps are closed until there are few runs."""
    starts = [i for i, s in enumerate(seen) if s and (i == 0 or not seen[i - 1])]
    ends = [i + 1 for i, s in enumerate(seen) if s and (i + 1 == len(seen) or not seen[i + 1])]
    gaps = sorted(range(1, len(starts)), key=lambda i: ends[i - 1] - starts[i])[: MOST_RUNS - 1]  # the widest, so negative, first
    kept = sorted(gaps)
    return list(zip([starts[i] for i in [0, *kept]], [ends[i - 1] for i in [*kept, len(starts)]], strict=True)) if starts else []


def bounds(g: Gaussians) -> tuple[torch.Tensor, torch.Tensor]:
    """Centres `[C, 3]` and radii `[C]`, float64, of spheres around the clusters' ellipsoids of 3.33 sigma; kept until the splats change."""
    made_from = (g.means._version, g.log_scales._version, g.log_scales.data_ptr(), len(g))
    kept = _bounds.get(g.means)
    if kept is None or kept[0] != made_from:
        kept = (made_from, _spheres(g))
        _bounds[g.means] = kept
    return kept[1]


def _spheres(g: Gaussians) -> tuple[torch.Tensor, torch.Tensor]:
    spare = -len(g) % CLUSTER  # the last cluster is filled up with its last splat
    means, reach = g.means.detach(), float(REACH) * g.log_scales.detach().amax(1).exp()
    means = torch.cat([means, means[-1:].expand(spare, 3)]).view(-1, CLUSTER, 3)
    reach = torch.cat([reach, reach[-1:].expand(spare)]).view(-1, CLUSTER)
    centres = 0.5 * (means.amin(1) + means.amax(1))
    radii = ((means - centres[:, None]).norm(dim=2) + reach).amax(1)
    # float32's rounding here and in the kernels
    return centres.double(), radii.double() * (1 + 1e-5) + 1e-5 * centres.double().norm(dim=1)
