"""USD layers: opened, written and checked, with USD's errors turned into Python's. One of the modules that import pxr.

Everything that is only Sidestep's own (the splat model, labels, original names) travels in the prims' custom data under "sidestep".
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch
from pxr import Gf, Tf, Usd, UsdGeom, UsdUtils, UsdValidation

from scenes.atomic import atomic_file
from scenes.poses import quat_from_matrix

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
            raise OSError(f"cannot write {path}: {first_line(error)}") from error


def open_stage(path: Path) -> tuple[Usd.Stage, list[str]]:
    """The composed stage and USD's warnings about it (which would otherwise go to stderr). ValueError where it is not USD."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist")
    with quiet() as said:
        try:
            stage = Usd.Stage.Open(str(path))
        except Tf.ErrorException as error:
            raise ValueError(f"{path} is not a whole USD file: {first_line(error)}") from error
    return stage, said


@contextmanager
def quiet() -> Iterator[list[str]]:
    """USD's warnings inside the block, as a list that is complete once it ends, instead of on stderr."""
    said: list[str] = []
    delegate = UsdUtils.CoalescingDiagnosticDelegate()
    try:
        yield said
    finally:
        said += [d.commentary for d in delegate.TakeUncoalescedDiagnostics()]
        del delegate


def first_line(error: Tf.ErrorException) -> str:
    """What USD says went wrong first, without its source lines."""
    said = [e.commentary for e in error.args if isinstance(e, Tf.Error)] or [str(error)]
    return " ".join(said[0].split())


def usd_problems(path: Path) -> list[str]:
    """What USD's own validators, all that are registered, object to in a file and all that it refers to."""
    stage, _ = open_stage(path)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    with quiet():
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
    """Give a prim a translate and an orient op in double precision: one rigid pose `[4, 4]`, or `[T, 4, 4]` at time codes."""
    xform = UsdGeom.Xformable(prim)
    translate = xform.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    orient = xform.AddOrientOp(UsdGeom.XformOp.PrecisionDouble)
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
    turn = pose[:3, :3]
    if not (turn @ turn.T - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-6 or not torch.linalg.det(turn) > 0:
        raise ValueError(f"{prim.GetPath()} has a transform that scales, shears or mirrors; splats here only move and turn")
    return pose


def array(attribute: Usd.Attribute, width: int) -> np.ndarray | None:
    """The numbers of an array attribute, float32 `[n, width]` (quaternions xyzw), at its first time; None where it has none."""
    value = attribute.Get(Usd.TimeCode.EarliestTime()) if attribute else None
    return None if value is None else np.array(value, np.float32).reshape(-1, width)
