"""An actor's deformation as attributes of its prim: the modes once, their weights as time samples, linear between as USD's are.

USD's own blend shapes (UsdSkel) are of meshes; usdview shows the splats where nothing moves them.
"""

from __future__ import annotations

import numpy as np
import torch
from pxr import Sdf, Usd, Vt

from scenes.deformation import Deformation
from scenes.usd.layers import array

CORNERS, MODES, COUNTS, WEIGHTS = (f"sidestep:deformation:{name}" for name in ("corners", "modes", "counts", "weights"))


def author_deformation(prim: Usd.Prim, deformation: Deformation, origin: int) -> None:
    """Give a prim a deformation whose times count from `origin`."""
    for name, vectors in ((CORNERS, deformation.corners), (MODES, deformation.modes)):
        flat = np.ascontiguousarray(vectors.detach().cpu().numpy().reshape(-1, 3))
        prim.CreateAttribute(name, Sdf.ValueTypeNames.Vector3fArray, True).Set(Vt.Vec3fArray.FromNumpy(flat))
    counts = Vt.IntArray(list(deformation.modes.shape[:4]))
    prim.CreateAttribute(COUNTS, Sdf.ValueTypeNames.IntArray, True, Sdf.VariabilityUniform).Set(counts)
    author_weights(prim, deformation, origin)


def author_weights(prim: Usd.Prim, deformation: Deformation, origin: int) -> None:
    """Give a prim a deformation's weights alone: an edit that gives it another path keeps the modes."""
    weights = prim.CreateAttribute(WEIGHTS, Sdf.ValueTypeNames.FloatArray, True)
    for time, row in zip((deformation.times_us - origin).tolist(), deformation.weights.detach().cpu().numpy(), strict=True):
        weights.Set(Vt.FloatArray.FromNumpy(np.ascontiguousarray(row)), time)


def read_deformation(prim: Usd.Prim, origin: int) -> Deformation | None:
    """The deformation of a prim, None where it has none. ValueError for one whose numbers do not fit together or are not finite."""
    weights = prim.GetAttribute(WEIGHTS)
    if not weights or not (samples := weights.GetTimeSamples()) or _replaced(prim):
        return None
    corners, modes, counts = array(prim.GetAttribute(CORNERS), 3), array(prim.GetAttribute(MODES), 3), prim.GetAttribute(COUNTS).Get()
    if corners is None or modes is None or counts is None:
        raise ValueError(f"{prim.GetPath()} has weights of a deformation without its {MODES}, {CORNERS} or {COUNTS}")
    rows = [np.array(weights.Get(t), np.float32) for t in samples]
    try:
        times = torch.tensor([round(t) + origin for t in samples])
        nodes = torch.from_numpy(modes.reshape(*counts, 3).copy())
        found = Deformation(torch.from_numpy(corners.copy()), nodes, times, torch.from_numpy(np.stack(rows)))
    except ValueError as error:
        raise ValueError(f"{prim.GetPath()} has a deformation whose numbers do not fit: {error}") from error
    found.validate(str(prim.GetPath()))
    return found


def _replaced(prim: Usd.Prim) -> bool:
    """Whether an edit put another asset in the place of the one that a prim's modes belong to: whichever layer says how an asset bends
    names the asset, too."""
    modes = prim.GetAttribute(MODES)
    bends = [spec.layer for spec in modes.GetPropertyStack(Usd.TimeCode.Default())] if modes else []
    assets = [spec.layer for spec in prim.GetPrimStack() if spec.hasReferences]
    return bool(bends) and bends[0] != assets[0]
