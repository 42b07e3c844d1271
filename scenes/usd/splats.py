"""Splats and assets as USD: a ParticleField3DGaussianSplat (UsdVol, in usd-core from 26.3) under an Xform.

USD keeps activated values: scale and opacity linear, quaternions normalised, SH coefficients per particle with the constant one
first. Logits are clamped to +-15 on the way. A float file returns them within 1 ulp; a half one keeps float positions, since half
ones lose centimetres, and 3 digits of everything else.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from pxr import Usd, UsdGeom, UsdVol, Vt

from scenes.asset import Asset
from scenes.asset_photos import load_photos, photos_beside
from scenes.formats.packing import log_scales_from, logits_from, opacities_from, scales_from, unit
from scenes.formats.transform import Z_FROM_Y_UP, moved
from scenes.gaussians import SH_COUNTS, Gaussians, SplatModel
from scenes.usd.layers import array, new_stage, open_stage, own_data, set_own_data

EXTENT_SIGMAS = 3.0
_SPLATS = "ParticleField3DGaussianSplat"
_HALF_MAX = 65504.0
Clean = Callable[[Gaussians, str], Gaussians]


def save_gaussians(path: Path, gaussians: Gaussians, model: SplatModel | None = None, half: bool = False) -> None:
    """Write splats, and the model they were trained with, as one USD file."""
    with new_stage(path, "Splats") as stage:
        root = UsdGeom.Xform.Define(stage, "/Splats")
        set_own_data(root.GetPrim(), kind="splats")
        author_splats(stage, "/Splats/Gaussians", gaussians, model, half)


def load_gaussians(path: Path, clean: Clean = Gaussians.checked) -> Gaussians:
    """The splats of a USD file that has exactly one splat prim, in the stage's frame: z up and in metres where it says how it differs."""
    with open_stage(path) as stage:
        prim = only_splats(stage.GetPseudoRoot(), path)
        transform = UsdGeom.XformCache(Usd.TimeCode.EarliestTime()).GetLocalToWorldTransform(prim)
        up, metres = _authored_axes(stage, path)
        upright = Z_FROM_Y_UP.clone() if up == "y" else torch.eye(4, dtype=torch.float64)
        upright[:3, :3] *= metres
        return clean(moved(read_splats(prim), upright @ torch.tensor(np.array(transform).T), path), str(path))  # USD's vectors are rows


def model_in(path: Path) -> SplatModel:
    """The model of the one splat prim of a USD file."""
    with open_stage(path) as stage:
        return read_model(only_splats(stage.GetPseudoRoot(), path))


def stage_axes(path: Path) -> tuple[str | None, float]:
    """Which axis of a USD file is up, "y" or "z", and the metres of its unit, as the file itself says; None and 1 where it does not.

    UsdGeom would then take y and 0.01. But splat tools that write neither mean the frame of their training, as in all their other files.
    """
    with open_stage(path) as stage:
        return _authored_axes(stage, path)


def _authored_axes(stage: Usd.Stage, path: Path) -> tuple[str | None, float]:
    up = UsdGeom.GetStageUpAxis(stage).lower() if stage.HasAuthoredMetadata(UsdGeom.Tokens.upAxis) else None
    metres = UsdGeom.GetStageMetersPerUnit(stage) if UsdGeom.StageHasAuthoredMetersPerUnit(stage) else 1.0
    if not (math.isfinite(metres) and metres > 0):
        raise ValueError(
            f"{path} says that its unit is {metres:g} metres (metersPerUnit), which is no length; set what it is, 1 for metres"
        )
    return up, metres


def save_asset(path: Path, asset: Asset, half: bool = False) -> None:
    """Write an asset as one USD file: its splats under an Xform that carries size, label and metadata; its photos beside it."""
    with photos_beside(path, asset.photos), new_stage(path, "Asset") as stage:
        root = UsdGeom.Xform.Define(stage, "/Asset").GetPrim()
        size = Vt.DoubleArray(asset.size.tolist())
        set_own_data(root, kind="asset", label=asset.label, size=size, meta=to_json(asset.meta, "the asset's meta"))
        author_splats(stage, "/Asset/Gaussians", asset.gaussians, asset.model, half)


def load_asset(path: Path, clean: Clean = Gaussians.checked) -> Asset:
    """The asset that `save_asset` wrote. ValueError where the file holds something else."""
    with open_stage(path) as stage:
        root = stage.GetDefaultPrim()
        if not root or own_data(root).get("kind") != "asset":
            raise ValueError(f"{path} is not an asset: its default prim carries no label and size")
        return read_asset(root, path, clean)


def read_asset(root: Usd.Prim, path: Path, clean: Clean) -> Asset:
    """The asset that a prim is, or refers to."""
    data, prim = own_data(root), only_splats(root, path)
    try:
        meta, size, label = json.loads(data["meta"]), torch.tensor(list(data["size"]), dtype=torch.float64), data["label"]
    except (KeyError, ValueError, TypeError) as error:
        raise ValueError(f"{path}: {root.GetPath()} is not an asset: it lacks {error}") from error
    splats = clean(read_splats(prim), f"{path}, {root.GetPath()}")
    return Asset(splats, size, label, read_model(prim), meta, load_photos(_asset_file(root, path)))


def _asset_file(root: Usd.Prim, path: Path) -> Path:
    """The file that an asset's label and size stand in, whoever refers to it."""
    files = [spec.layer.realPath for spec in root.GetPrimStack() if "label" in spec.customData.get("sidestep", {})]
    return Path(files[-1]) if files and files[-1] else path


def author_splats(stage: Usd.Stage, where: str, gaussians: Gaussians, model: SplatModel | None, half: bool) -> None:
    """Define a splat prim at a path of the stage."""
    g = {name: t.detach().cpu().numpy().astype(np.float64) for name, t in gaussians.tensors().items()}
    n, k = len(gaussians), gaussians.sh.shape[1]
    scales = scales_from(g["log_scales"], "f2" if half else "f4")
    opacities, quats = opacities_from(g["logit_opacities"]), unit(g["quats"])
    sh = g["sh"].reshape(n * k, 3)
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, where)
    splats.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(g["means"].astype(np.float32)))
    xyzw = np.ascontiguousarray(quats[:, [1, 2, 3, 0]])
    if half:
        sh = sh.clip(-_HALF_MAX, _HALF_MAX)
        splats.CreateOrientationshAttr(Vt.QuathArray.FromNumpy(xyzw.astype(np.float16)))
        splats.CreateScaleshAttr(Vt.Vec3hArray.FromNumpy(scales.astype(np.float16)))
        splats.CreateOpacitieshAttr(Vt.HalfArray.FromNumpy(opacities.astype(np.float16)))
        splats.CreateRadianceSphericalHarmonicsCoefficientshAttr(Vt.Vec3hArray.FromNumpy(sh.astype(np.float16)))
    else:
        splats.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(xyzw.astype(np.float32)))
        splats.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales.astype(np.float32)))
        splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(opacities.astype(np.float32)))
        splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(Vt.Vec3fArray.FromNumpy(sh.astype(np.float32)))
    splats.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
    splats.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(_extent(g["means"], quats, scales)))
    if model is not None:
        set_own_data(splats.GetPrim(), model=asdict(model))


def read_splats(prim: Usd.Prim) -> Gaussians:
    """The splats of a prim, as they come: float attributes, or the half ones where there are no float ones."""
    splats = UsdVol.ParticleField3DGaussianSplat(prim)
    means = _either(prim, splats.GetPositionsAttr(), splats.GetPositionshAttr(), 3)
    quats = _either(prim, splats.GetOrientationsAttr(), splats.GetOrientationshAttr(), 4)
    scales = _either(prim, splats.GetScalesAttr(), splats.GetScaleshAttr(), 3)
    opacities = _either(prim, splats.GetOpacitiesAttr(), splats.GetOpacitieshAttr(), 1)
    radiance = splats.GetRadianceSphericalHarmonicsCoefficientsAttr(), splats.GetRadianceSphericalHarmonicsCoefficientshAttr()
    sh = _either(prim, *radiance, 3)
    degree, n = splats.GetRadianceSphericalHarmonicsDegreeAttr().Get(), len(means)
    if not 0 <= degree < len(SH_COUNTS):
        raise ValueError(f"{prim.GetPath()} has spherical harmonics of degree {degree}; 0 to 3 are read")
    counts = {"orientations": (len(quats), n), "scales": (len(scales), n), "opacities": (len(opacities), n)}
    counts["sphericalHarmonicsCoefficients"] = (len(sh), n * SH_COUNTS[degree])
    for name, (found, wanted) in counts.items():
        if found != wanted:
            raise ValueError(f"{prim.GetPath()} has {found} {name} for {n} positions of SH degree {degree}; it needs {wanted}")
    fields = (
        means,
        quats[:, [3, 0, 1, 2]],
        log_scales_from(scales.astype(np.float64)),
        logits_from(opacities[:, 0]),
        sh.reshape(n, SH_COUNTS[degree], 3),
    )
    return Gaussians(*(torch.from_numpy(np.ascontiguousarray(f, np.float32)) for f in fields))


def read_model(prim: Usd.Prim) -> SplatModel:
    """The model that a splat prim was trained with; the default one where it does not say."""
    model = own_data(prim).get("model", {})
    try:
        return SplatModel(**model)
    except TypeError as error:
        raise ValueError(f"{prim.GetPath()} names an unknown splat model: {model}") from error


def only_splats(root: Usd.Prim, path: Path) -> Usd.Prim:
    """The one splat prim at or under a prim."""
    found = [p for p in Usd.PrimRange(root) if p.GetTypeName() == _SPLATS]
    if len(found) != 1:
        paths = ", ".join(str(p.GetPath()) for p in found[:4]) or "none"
        missing = missing_files(root)
        why = f"; {missing[0]} is missing" if missing else ""
        raise ValueError(f"{path}: {root.GetPath()} must hold one {_SPLATS}, it has {paths}{why}")
    return found[0]


def missing_files(prim: Usd.Prim) -> list[Path]:
    """Files that the prim refers to and that do not exist."""
    files = []
    for spec in prim.GetPrimStack():
        for arcs in (spec.referenceList, spec.payloadList):
            files += [Path(spec.layer.ComputeAbsolutePath(a.assetPath)) for a in arcs.GetAddedOrExplicitItems() if a.assetPath]
    return [f for f in files if not f.is_file()]


def to_json(value: object, what: str) -> str:
    """JSON text; ValueError where `value` is not plain json."""
    try:
        return json.dumps(value, allow_nan=False, ensure_ascii=False)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} cannot be stored as JSON: {error}") from error


def _either(prim: Usd.Prim, full: Usd.Attribute, half: Usd.Attribute, width: int) -> np.ndarray:
    value = array(full, width)
    value = array(half, width) if value is None else value
    if value is None:
        raise ValueError(f"{prim.GetPath()} has no {full.GetName()}")
    return value


def _extent(means: np.ndarray, quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """float32 `[2, 3]`: corners of the box around all splats at 3 sigma; quats wxyz normalised."""
    if not len(means):
        return np.zeros((2, 3), np.float32)
    w, x, y, z = quats.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    half = EXTENT_SIGMAS * np.sqrt(np.square(np.array(rows) * scales.T).sum(1)).T
    most = np.finfo("f4").max
    return np.stack([(means - half).min(0), (means + half).max(0)]).clip(-most, most).astype(np.float32)
