"""A scene's ground as a USD mesh: its height field, kept in the points and in data of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from pxr import Usd, UsdGeom, Vt

from scenes.ground import Ground
from scenes.usd.layers import array, new_stage, own_data, set_own_data


def save_ground(path: Path, ground: Ground) -> None:
    """Write a height field as a mesh of quads, a guide that is not rendered, with its grid as data of its own."""
    ny, nx = ground.heights.shape
    heights = ground.heights.detach().cpu().numpy()
    y, x = np.meshgrid(np.arange(ny), np.arange(nx), indexing="ij")
    points = np.stack([ground.origin[0] + x * ground.cell, ground.origin[1] + y * ground.cell, heights], -1)
    corner = (y * nx + x)[:-1, :-1].reshape(-1, 1)
    faces = corner + np.array([0, 1, nx + 1, nx])
    with new_stage(path, "Ground") as stage:
        mesh = UsdGeom.Mesh.Define(stage, "/Ground")
        points = points.reshape(-1, 3).astype(np.float32)
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 4, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(faces.reshape(-1).astype(np.int32)))
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(np.stack([points.min(0), points.max(0)])))
        mesh.CreateSubdivisionSchemeAttr("none")
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreatePurposeAttr("guide")
        grid = {"origin": Vt.DoubleArray([float(v) for v in ground.origin]), "cell": float(ground.cell), "rows": ny, "columns": nx}
        set_own_data(mesh.GetPrim(), **grid)


def load_ground(stage: Usd.Stage, path: Path) -> Ground | None:
    """A scene's height field, None where it has none. FileNotFoundError where its file is gone, ValueError where that is no height
    field."""
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/Ground"))
    if not mesh:
        return None
    data, points = own_data(mesh.GetPrim()), array(mesh.GetPointsAttr(), 3)
    if points is None:
        raise FileNotFoundError(f"{path} lacks its ground: {path / 'ground.usdc'} is missing")
    try:
        heights = points[:, 2].reshape(data["rows"], data["columns"])
        return Ground(torch.from_numpy(heights.copy()), tuple(data["origin"]), data["cell"])
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path / 'ground.usdc'} is not a height field: {error}") from error
