"""Splats on the surface of a mesh, as dense everywhere, and coloured as under an even sky."""

from __future__ import annotations

import math

import numpy as np
import torch

from render.tracer import Blockers, Mesh, fibonacci, lit
from scenes.gaussians import Gaussians, SplatModel
from scenes.harmonics import sh_from_rgb
from scenes.poses import matrix_from_quat, quat_from_matrix

MODEL = SplatModel(projection="ewa")


def splats_of_mesh(mesh: Mesh, count: int) -> Gaussians:
    """About `count` splats on what can be seen of a mesh: as dense everywhere, flat on their triangles, coloured as under an even sky."""
    blockers = Blockers(mesh.vertices[mesh.faces])
    share = float(_in_the_open(sampled(mesh, 4000), blockers).sum()) / 4000
    splats = sampled(mesh, round(count / max(share, 0.2)))
    return splats.select(_in_the_open(splats, blockers))


def _in_the_open(splats: Gaussians, blockers: Blockers) -> torch.Tensor:
    """Mask `[N]` of flat splats that see something of the outside on either of their faces: seats and the insides of doors do not."""
    normals = matrix_from_quat(splats.quats)[:, :, 2]
    around = fibonacci(64)
    sides = [blockers.open_share(splats.means + side * 0.004 * normals, around, torch.ones(64), 100.0) for side in (1, -1)]
    return (sides[0] > 0.01) | (sides[1] > 0.01)


def areas(mesh: Mesh) -> np.ndarray:
    """Square metres `[F]` of a mesh's faces."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def sampled(mesh: Mesh, count: int) -> Gaussians:
    """Splats evenly over all of a mesh's surface that is not see-through."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(a, b)
    ends = np.cumsum(areas(mesh))
    # even steps along the area, and within a triangle the R2 sequence (Roberts 2018): as even as random, without its clumps
    face = np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1]).clip(0, len(ends) - 1)
    u, v = np.modf(np.arange(count) * 0.7548776662466927)[0], np.modf(np.arange(count) * 0.5698402909980532)[0]
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    weights = np.stack([1 - u - v, u, v], 1)[..., None]
    means = (corners[face] * weights).sum(1)
    normals = (mesh.normals[face] * weights).sum(1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-9)
    colours = _texels(mesh, face, (mesh.uvs[face] * weights).sum(1)) * (mesh.tints[face] * weights).sum(1)
    solid = colours[:, 3] >= mesh.opaque_from
    flat = cross[face] / np.linalg.norm(cross[face], axis=1, keepdims=True).clip(1e-12)
    axis = a[face] / np.linalg.norm(a[face], axis=1, keepdims=True).clip(1e-12)
    frame = torch.from_numpy(np.stack([axis, np.cross(flat, axis), flat], 2))
    spacing = math.sqrt(ends[-1] / count)
    keep = torch.from_numpy(solid)
    rgb = lit(torch.from_numpy(colours[:, :3]).float(), torch.from_numpy(normals).float())
    scales = torch.tensor([0.6 * spacing, 0.6 * spacing, 0.08 * spacing]).log().repeat(count, 1)
    whole = Gaussians(
        torch.from_numpy(means).float(), quat_from_matrix(frame).float(), scales, torch.full((count,), 2.0), sh_from_rgb(rgb)[:, None]
    )
    return whole.select(keep)


def _texels(mesh: Mesh, face: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours rgba `[N, 4]` in 0..1 at texture coordinates `[N, 2]` of faces `[N]`: the nearest texel."""
    out = np.zeros((len(face), 4))
    for i, texture in enumerate(mesh.textures):
        own = mesh.texture[face] == i
        h, w = texture.shape[:2]
        column, row = (np.floor(uv[own] * [w, h]).astype(np.int64) % [w, h]).T
        out[own] = texture[row, column] / 255
    return out
