"""GLB with KHR_gaussian_splatting (Khronos, ratified 2026): float attributes of a point primitive, mapped from the file.

SCALE and OPACITY are linear, ROTATION is xyzw, SH_DEGREE_d_COEF_n has a VEC3 a coefficient with the constant one as degree 0. glTF is
Y up: the node of what is written here turns Z up into that, so the numbers stay as they are, and what is read is turned as its nodes
and then Z up say, harmonics included. Drafts had _ROTATION and _SCALE, and colour and opacity in COLOR_0; with one of the drafts'
extensions for it, splats are packed as SPZ.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from scenes.atomic import atomic_file
from scenes.formats.gltf import CHUNK, HEADER, WIDTHS, accessor, primitives, read_glb, view_bytes
from scenes.formats.packing import assembled, follows, log_scales_from, logits_from, opacities_from, scales_from, stored, unit
from scenes.formats.spz import unpacked
from scenes.formats.transform import moved
from scenes.gaussians import SH_COUNTS, Gaussians
from scenes.harmonics import sh_from_rgb

_NAME = "KHR_gaussian_splatting"
_SPZ = (f"{_NAME}_compression_spz_2", f"{_NAME}_compression_spz")
_DRAFT = "KHR_spz_gaussian_splats_compression"
_NAMES = {width: name for name, width in WIDTHS.items()}
_SPACE = "srgb_rec709_display"
_Y_FROM_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # a quarter turn about x, xyzw


def load_glb(path: str | os.PathLike, clean: Callable[[Gaussians, str], Gaussians] = Gaussians.checked) -> Gaussians:
    """All splats of a GLB file's scene, Z up. ValueError where it holds none, is not whole, has colours that are not sRGB's, or is scaled
    by 0.

    `clean(gaussians, where)` answers for the values.
    """
    path = Path(path)
    tree, binary = read_glb(path)
    with follows(path, "glTF 2.0"):
        found = [(p, pose) for p, pose in primitives(path, tree) if not p.get("extensions", {}).keys().isdisjoint((_NAME, _DRAFT))]
        parts = [moved(_splats(path, tree, binary, primitive), pose, path) for primitive, pose in found]
    if not parts:
        what = "a mesh" if tree.get("meshes") else "empty"
        raise ValueError(f"{path} is {what}, not splats: nothing in its scene uses {_NAME}")
    return clean(parts[0] if len(parts) == 1 else Gaussians.cat(parts), str(path))


def save_glb(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Write splats: positions and harmonics bit for bit, scales and opacities linear, logits clamped to +-15.

    ValueError where there is none: glTF knows no empty buffers.
    """
    if not len(gaussians):
        raise ValueError(f"{path} cannot be written: a GLB file holds at least one splat")
    g = stored(gaussians)
    scales = scales_from(g["log_scales"])
    columns = {
        "POSITION": g["means"], f"{_NAME}:ROTATION": unit(g["quats"])[:, [1, 2, 3, 0]], f"{_NAME}:SCALE": scales,
        f"{_NAME}:OPACITY": opacities_from(g["logit_opacities"])[:, None],
    }  # fmt: skip
    columns |= {name: g["sh"][:, i] for i, name in enumerate(_coefficients(gaussians.sh_degree))}
    n, at = len(gaussians), 0
    views: list[dict] = []
    accessors: list[dict] = []
    for name, column in columns.items():
        width = column.shape[1]
        bounds = {"min": column.min(0).tolist(), "max": column.max(0).tolist()} if name == "POSITION" else {}
        accessors.append({"bufferView": len(views), "componentType": 5126, "count": n, "type": _NAMES[width], **bounds})
        views.append({"buffer": 0, "byteOffset": at, "byteLength": 4 * n * width})
        at += 4 * n * width
    about = {"kernel": "ellipse", "colorSpace": _SPACE, "projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive = {"mode": 0, "attributes": {name: i for i, name in enumerate(columns)}, "extensions": {_NAME: about}}
    tree = {
        "asset": {"version": "2.0", "generator": "Sidestep"}, "extensionsUsed": [_NAME], "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _Y_FROM_Z_UP}], "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}], "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    with atomic_file(path) as partial, open(partial, "wb") as file:
        file.write(HEADER.pack(b"glTF", 2, HEADER.size + 2 * CHUNK.size + len(text) + at))
        file.write(CHUNK.pack(len(text), b"JSON") + text + CHUNK.pack(at, b"BIN\0"))
        for column in columns.values():
            file.write(np.ascontiguousarray(column, "<f4").data)


def _coefficients(degree: int) -> list[str]:
    return [f"{_NAME}:SH_DEGREE_{d}_COEF_{i}" for d in range(degree + 1) for i in range(2 * d + 1)]


def _splats(path: Path, tree: dict, binary: np.ndarray, primitive: dict) -> Gaussians:
    about = primitive["extensions"].get(_NAME, {})
    for key, known in (("kernel", "ellipse"), ("colorSpace", _SPACE)):
        if about.get(key, known) != known:
            raise ValueError(f"{path} has splats whose {key} is {about[key]!r}, and {known!r} is read; export them as that")
    further = dict(about.get("extensions", {}))
    if _DRAFT in primitive["extensions"]:
        further[_SPZ[0]] = primitive["extensions"][_DRAFT]
    view = next((further[name]["bufferView"] for name in _SPZ if name in further), None)
    if view is not None:
        return unpacked(view_bytes(path, tree, binary, view).tobytes(), f"{path}, buffer view {view},")
    packed = [name for name in further if "compression" in name and name not in _SPZ]
    if packed:
        raise ValueError(f"{path} has its splats packed by {packed[0]}, which is not read; export it without compression")
    return _unpacked(path, tree, binary, {_since(name): index for name, index in primitive["attributes"].items()})


def _since(name: str) -> str:
    """The ratified name of an attribute of a draft."""
    return f"{_NAME}:{name[1:]}" if name in ("_ROTATION", "_SCALE") or name.startswith("_SH_DEGREE_") else name


def _unpacked(path: Path, tree: dict, binary: np.ndarray, attributes: dict[str, int]) -> Gaussians:
    degree = next((d for d in (3, 2, 1) if f"{_NAME}:SH_DEGREE_{d}_COEF_0" in attributes), 0)
    widths = {"POSITION": 3, f"{_NAME}:ROTATION": 4, f"{_NAME}:SCALE": 3}
    constant, opacity = f"{_NAME}:SH_DEGREE_0_COEF_0", f"{_NAME}:OPACITY"
    drafted = "COLOR_0" in attributes and constant not in attributes and opacity not in attributes
    widths |= {"COLOR_0": 4} if drafted else {opacity: 1, constant: 3}
    widths |= dict.fromkeys(_coefficients(degree)[1:], 3)
    missing = [name for name in widths if name not in attributes]
    if missing:
        raise ValueError(f"{path} has splats without {', '.join(missing[:4])}")
    columns = {name: accessor(path, tree, binary, attributes[name], width) for name, width in widths.items()}
    counts = {len(column) for column in columns.values()}
    if len(counts) != 1:
        raise ValueError(f"{path} is corrupt: its attributes have {', '.join(map(str, sorted(counts)))} values")
    if drafted:
        columns |= {constant: sh_from_rgb(columns["COLOR_0"][:, :3]), opacity: columns["COLOR_0"][:, 3:]}
    means, quats, scales = columns["POSITION"], columns[f"{_NAME}:ROTATION"], columns[f"{_NAME}:SCALE"]
    sh = np.empty((len(means), SH_COUNTS[degree], 3), np.float32)
    for i, name in enumerate(_coefficients(degree)):
        sh[:, i] = columns[name]
    return assembled(means, quats[:, [3, 0, 1, 2]], log_scales_from(scales), logits_from(columns[opacity][:, 0]), sh)
