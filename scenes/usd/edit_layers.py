"""The edit layers of a scene's stage: which there are, and whether they are whole."""

from __future__ import annotations

import json
import re
from pathlib import Path
from shlex import quote

from pxr import Sdf, Tf, Usd

from scenes.usd.root import RECORDED


def read_edits(stage: Usd.Stage) -> list[dict]:
    """Name and metadata of the edit layers that a scene's stage has, the oldest first; `missing` where the file is gone."""
    root, out = stage.GetRootLayer(), []
    for sub in (s for s in reversed(list(root.subLayerPaths)) if s != RECORDED):
        layer = Sdf.Layer.Find(root.ComputeAbsolutePath(sub))
        data = dict(layer.customLayerData) if layer else {}
        told = json.loads(data.get("sidestep_edit", "{}")) if layer else {"missing": True}
        out.append({**told, "name": Path(sub).stem})
    return out


def check_edits(stage: Usd.Stage, path: Path) -> None:
    """ValueError where an edit's layer is there, and it or a file that it refers to is missing, damaged, or ends with its header."""
    root = stage.GetRootLayer()
    for sub in (s for s in root.subLayerPaths if s != RECORDED and (path / s).exists()):
        layer = Sdf.Layer.Find(root.ComputeAbsolutePath(sub))
        below = layer.GetCompositionAssetDependencies() if layer else ()
        for file in (f for f in (path / sub, *(path / "edits" / s for s in below)) if not _says_something(f)):
            how, name = "damaged" if file.exists() else "missing", Path(sub).stem
            fix = f"restore it, or undo the edit: sidestep edit {quote(str(path))} --undo {name}"
            raise ValueError(f"{file} is {how}, so the edit {name} cannot be applied; {fix}")


def _says_something(file: Path) -> bool:
    """Whether a layer is there, can be read, and has a prim."""
    try:
        layer = Sdf.Layer.FindOrOpen(str(file))
    except Tf.ErrorException:
        return False
    return bool(layer and layer.rootPrims)


def is_edit_name(name: str) -> bool:
    """Whether an edit may have this name."""
    return re.fullmatch(r"[A-Za-z0-9][\w-]*", name, flags=re.ASCII) is not None
