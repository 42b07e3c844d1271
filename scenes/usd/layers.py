"""USD layers: opened, written and checked, with USD's errors turned into Python's. One of the modules that import pxr.

Everything that is only Sidestep's own (the splat model, labels, original names) travels in the prims' custom data under "sidestep".
"""

from __future__ import annotations

import errno
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np
import torch
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdUtils, UsdValidation

from scenes.atomic import FULL, atomic_file
from scenes.poses import quat_from_matrix, unturned
from scenes.usd.crate import check_crate

TICKS = 1_000_000  # time codes a second: one a microsecond
SUFFIXES = (".usdc", ".usda", ".usd")


@contextmanager
def new_stage(path: Path, default_prim: str) -> Iterator[Usd.Stage]:
    """A stage, Z up and in metres, whose root layer appears at `path` when the block ends. OSError where it cannot be written."""
    with atomic_file(path) as partial:
        partial.unlink()  # USD makes the file itself, and refuses one that is empty
        try:
            stage = Usd.Stage.CreateNew(str(partial))
            UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
            UsdGeom.SetStageMetersPerUnit(stage, 1.0)
            stage.SetTimeCodesPerSecond(TICKS)
            stage.SetFramesPerSecond(10)
            yield stage
            stage.SetDefaultPrim(stage.GetPrimAtPath(f"/{default_prim}"))
            stage.GetRootLayer().Save()
        except Tf.ErrorException as error:
            # with the file's name apart: where it stands in a folder that is not whole yet, that gives its own
            said = first_line(error)
            full = next((code for code in FULL if os.strerror(code) in said), None)
            raise OSError(full or errno.EIO, os.strerror(full) if full else said, str(path)) from error


@contextmanager
def open_stage(path: Path) -> Iterator[Usd.Stage]:
    """The composed stage of a file, fresh from the disk. What USD or the block finds wrong becomes a ValueError that names it."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist")
    check_crate(path)
    with _quiet():
        try:
            # USD shares layers within a process, also those that have changed on disk since
            root = Sdf.Layer.FindOrOpen(str(path))
            root.Reload()
            stage = Usd.Stage.Open(root)
            fresh = {root.identifier}
            # one by one, since what a reloaded layer no longer names is gone, and what it newly names may be stale
            while stale := next((layer for layer in stage.GetUsedLayers() if layer.identifier not in fresh), None):
                fresh.add(stale.identifier)
                if os.path.exists(stale.realPath):
                    stale.Reload()
            yield stage
        except Tf.ErrorException as error:
            raise ValueError(f"{path} is not a valid USD file: {first_line(error)}") from error
        except ValueError as error:  # of a prim, which may stand in one of many files
            if str(path) in str(error):
                raise
            raise ValueError(f"{path}: {error}") from error


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep USD's warnings off stderr: a missing file is found, and told in this project's words, by who needs it."""
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield
    finally:
        with suppress(UnicodeDecodeError):  # of a damaged file, which they quote
            delegate.TakeUncoalescedDiagnostics()
        del delegate


def first_line(error: Tf.ErrorException) -> str:
    """What USD says went wrong first, without its source lines."""
    try:
        said = [e.commentary for e in error.args if isinstance(e, Tf.Error)] or [str(error)]
    except UnicodeDecodeError:
        return "USD quotes of it what is not text"
    return " ".join(said[0].split())


def usd_problems(path: Path) -> list[str]:
    """What USD's own validators, all that are registered, object to in a file and all that it refers to."""
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    with open_stage(path) as stage:
        errors = UsdValidation.ValidationContext(validators).Validate(stage)
        return [" ".join(f"{e.GetName()}: {e.GetMessage()}".split()) for e in errors]


def valid_names(names: Iterable[str], taken: Iterable[str] = ()) -> dict[str, str]:
    """A prim and file name for each name: an identifier, different from the others and from `taken` whatever the case."""
    used, out = {t.casefold() for t in taken}, {}
    for name in names:
        stem = re.sub(r"\W", "_", name, flags=re.ASCII) or "_"
        stem = f"_{stem}" if stem[0].isdigit() else stem
        candidate, count = stem, 2
        while candidate.casefold() in used:
            candidate, count = f"{stem}_{count}", count + 1
        used.add(candidate.casefold())
        out[name] = candidate
    return out


def own_data(prim: Usd.Prim) -> dict:
    """Sidestep's custom data of a prim, {} where it has none."""
    return prim.GetCustomDataByKey("sidestep") or {}


def set_own_data(prim: Usd.Prim, **data) -> None:
    """Add to Sidestep's custom data of a prim, in the layer being written only."""
    for key, value in data.items():
        prim.SetCustomDataByKey(f"sidestep:{key}", value)


def author_pose(prim: Usd.Prim, poses: torch.Tensor, times: list[int] | None = None) -> None:
    """Give a prim a translate and an orient op in double precision: one rigid pose `[4, 4]`, or `[T, 4, 4]` at time codes.

    A prim that only overrides gets the ops' values: their order is its definition's, of the same kind.
    """
    for pose in poses.reshape(-1, 4, 4):
        _check_rigid(str(prim.GetPath()), pose)
    if max(map(abs, times or [0])) > 2**53:
        raise ValueError(f"{prim.GetPath()} has a time {max(map(abs, times or [0]))} us from the drive's first, which USD cannot hold")
    translate = prim.CreateAttribute("xformOp:translate", Sdf.ValueTypeNames.Double3, False)
    orient = prim.CreateAttribute("xformOp:orient", Sdf.ValueTypeNames.Quatd, False)
    if prim.IsDefined():
        UsdGeom.Xformable(prim).SetXformOpOrder([UsdGeom.XformOp(translate), UsdGeom.XformOp(orient)])
    codes = [Usd.TimeCode.Default()] if times is None else times
    poses = poses.detach().cpu().reshape(-1, 4, 4)
    moves, turns = poses[:, :3, 3].tolist(), quat_from_matrix(poses[:, :3, :3]).tolist()
    for code, move, turn in zip(codes, moves, turns, strict=True):
        translate.Set(Gf.Vec3d(*move), code)
        orient.Set(Gf.Quatd(*turn), code)


def local_pose(prim: Usd.Prim) -> torch.Tensor:
    """The prim's pose in its parent, float64 `[4, 4]`, at its first time. ValueError where it is not rigid."""
    return _rigid(prim, UsdGeom.Xformable(prim).GetLocalTransformation(Usd.TimeCode.EarliestTime()))


def world_poses(prim: Usd.Prim) -> tuple[list[float], torch.Tensor]:
    """The prim's pose samples: time codes `[T]` (0 for a still one) and float64 poses `[T, 4, 4]` in the world."""
    codes = UsdGeom.Xformable(prim).GetTimeSamples()
    at = [Usd.TimeCode(c) for c in codes] or [Usd.TimeCode.Default()]
    poses = [_rigid(prim, UsdGeom.XformCache(t).GetLocalToWorldTransform(prim)) for t in at]
    return codes or [0.0], torch.stack(poses)


def _rigid(prim: Usd.Prim, matrix: Gf.Matrix4d) -> torch.Tensor:
    pose = torch.from_numpy(np.array(matrix).T.copy())
    _check_rigid(str(prim.GetPath()), pose)
    return pose


def _check_rigid(where: str, pose: torch.Tensor) -> None:
    if not unturned(pose).abs().max() < 1e-6 or not torch.linalg.det(pose[:3, :3]) > 0 or not torch.isfinite(pose).all():
        raise ValueError(f"{where} has a transform that scales, shears, mirrors or is not finite; poses here only move and turn")


def array(attribute: Usd.Attribute, width: int) -> np.ndarray | None:
    """The numbers of an array attribute, float32 `[n, width]` (quaternions xyzw), at its first time; None where it has none."""
    value = attribute.Get(Usd.TimeCode.EarliestTime()) if attribute else None
    return None if value is None else np.array(value, np.float32).reshape(-1, width)
