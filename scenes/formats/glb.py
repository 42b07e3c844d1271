"""GLB with KHR_gaussian_splatting (Khronos, ratified 2026): float attributes of a point primitive, mapped from the file.

SCALE and OPACITY are linear, ROTATION is xyzw, SH_DEGREE_d_COEF_n has a VEC3 a coefficient with the constant one as degree 0. glTF is
Y up: the node of what is written here turns Z up into that, so the numbers stay as they are, and what is read is turned as its nodes
and then Z up say, harmonics included.
"""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from scenes.atomic import atomic_file
from scenes.formats.packing import assembled, follows, logits_from, opacities_from, parsed, stored, unit
from scenes.gaussians import SH_COUNTS, Gaussians
from scenes.harmonics import turned
from scenes.poses import matrix_from_quat, quat_from_matrix, quat_product

_NAME = "KHR_gaussian_splatting"
_HEADER, _CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_NAMES = {width: name for name, width in _WIDTHS.items()}
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_FLOAT = np.finfo("f4")
_Y_FROM_Z_UP = [-(0.5**0.5), 0.0, 0.0, 0.5**0.5]  # a quarter turn about x, xyzw


def load_glb(path: str | os.PathLike, clean: Callable[[Gaussians, str], Gaussians] = Gaussians.checked) -> Gaussians:
    """All splats of a GLB file's scene, Z up. ValueError where it holds none, is not whole, or its nodes shear, mirror or stretch.

    `clean(gaussians, where)` answers for the values.
    """
    path = Path(path)
    tree, binary = _read(path)
    with follows(path, "glTF 2.0"):
        parts = [_moved(_splats(path, tree, binary, primitive), pose, path) for primitive, pose in _placed(path, tree)]
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
    scales = np.exp(g["log_scales"].astype(np.float64)).clip(_FLOAT.tiny, _FLOAT.max)
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
    about = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", "projection": "perspective", "sortingMethod": "cameraDistance"}
    primitive = {"mode": 0, "attributes": {name: i for i, name in enumerate(columns)}, "extensions": {_NAME: about}}
    tree = {
        "asset": {"version": "2.0", "generator": "Sidestep"}, "extensionsUsed": [_NAME], "scene": 0, "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "rotation": _Y_FROM_Z_UP}], "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": at}], "bufferViews": views, "accessors": accessors,
    }  # fmt: skip
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    with atomic_file(path) as partial, open(partial, "wb") as file:
        file.write(_HEADER.pack(b"glTF", 2, _HEADER.size + 2 * _CHUNK.size + len(text) + at))
        file.write(_CHUNK.pack(len(text), b"JSON") + text + _CHUNK.pack(at, b"BIN\0"))
        for column in columns.values():
            file.write(np.ascontiguousarray(column, "<f4").data)


def _coefficients(degree: int) -> list[str]:
    return [f"{_NAME}:SH_DEGREE_{d}_COEF_{i}" for d in range(degree + 1) for i in range(2 * d + 1)]


def _read(path: Path) -> tuple[dict, np.ndarray]:
    """The JSON of a file and its binary chunk, mapped; each claimed size is checked against the file's."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(_HEADER.size + _CHUNK.size)
        if not head.startswith(b"glTF") or len(head) < _HEADER.size + _CHUNK.size:
            raise ValueError(f"{path} is not a GLB file: it does not start with glTF and a chunk")
        _, version, total = _HEADER.unpack_from(head)
        length, kind = _CHUNK.unpack_from(head, _HEADER.size)
        if version != 2 or total != size or kind != b"JSON" or len(head) + length > size:
            raise ValueError(f"{path} is truncated or corrupt: its header claims glTF {version}, {total} bytes; it has {size}")
        text = file.read(length)
        at = len(head) + length
        tail = file.read(_CHUNK.size)
    tree = parsed(path, text)
    if len(tail) < _CHUNK.size:
        return tree, np.zeros(0, np.uint8)
    length, kind = _CHUNK.unpack(tail)
    if kind != b"BIN\0" or at + _CHUNK.size + length > size:
        raise ValueError(f"{path} is truncated or corrupt: its second chunk claims {length} bytes of {kind!r}")
    return tree, np.memmap(path, np.uint8, "r", at + _CHUNK.size, (length,)) if length else np.zeros(0, np.uint8)


def _placed(path: Path, tree: dict) -> Iterator[tuple[dict, torch.Tensor]]:
    """The scene's splat primitives, each with its float64 transform `[4, 4]` to Z up. A node may stand in the tree once."""
    z_from_y = torch.eye(4, dtype=torch.float64)
    z_from_y[1:3, 1:3] = torch.tensor([[0.0, -1.0], [1.0, 0.0]])
    todo = [(i, z_from_y) for i in _item(tree, "scenes", tree.get("scene", 0)).get("nodes", [])]
    seen = set()
    while todo:
        index, above = todo.pop()
        node = _item(tree, "nodes", index)
        if index in seen:
            raise ValueError(f"{path} is corrupt: node {index} stands in its tree twice")
        seen.add(index)
        pose = above @ _transform(node)
        todo += [(child, pose) for child in node.get("children", [])]
        if "mesh" in node:
            for primitive in _item(tree, "meshes", node["mesh"])["primitives"]:
                if _NAME in primitive.get("extensions", {}):
                    yield primitive, pose


def _item(tree: dict, kind: str, index: int) -> dict:
    """An entry of one of glTF's lists; not Python's idea of index -1 or True."""
    if type(index) is not int or index < 0:
        raise KeyError(f"{kind}[{index!r}]")
    item = tree[kind][index]
    if not isinstance(item, dict):
        raise TypeError(f"{kind}[{index}] is no object")
    return item


def _transform(node: dict) -> torch.Tensor:
    """A node's float64 `[4, 4]`."""
    if "matrix" in node:
        return torch.tensor([float(v) for v in node["matrix"]], dtype=torch.float64).reshape(4, 4).T
    pose = torch.eye(4, dtype=torch.float64)
    x, y, z, w = (float(v) for v in node.get("rotation", (0, 0, 0, 1)))
    scale = torch.tensor([float(v) for v in node.get("scale", (1, 1, 1))], dtype=torch.float64)
    pose[:3, :3] = matrix_from_quat(torch.tensor([w, x, y, z], dtype=torch.float64)) * scale
    pose[:3, 3] = torch.tensor([float(v) for v in node.get("translation", (0, 0, 0))], dtype=torch.float64)
    return pose


def _moved(gaussians: Gaussians, pose: torch.Tensor, path: Path) -> Gaussians:
    """Splats under a transform that turns, moves and scales evenly; the same object where it does nothing."""
    if (pose - torch.eye(4)).abs().max() < 1e-7:
        return gaussians
    scale = torch.linalg.det(pose[:3, :3]).clamp_min(0) ** (1 / 3)
    turn = pose[:3, :3] / scale
    if not (turn @ turn.T - torch.eye(3)).abs().max() < 1e-5:
        raise ValueError(f"{path} has splats under a node that shears, mirrors or stretches, which splats cannot follow")
    return replace(
        gaussians,
        means=(gaussians.means.double() @ pose[:3, :3].T + pose[:3, 3]).float(),
        quats=quat_product(quat_from_matrix(turn).float(), gaussians.quats),
        log_scales=gaussians.log_scales + scale.log().float(),
        sh=turned(gaussians.sh, turn),
    )


def _splats(path: Path, tree: dict, binary: np.ndarray, primitive: dict) -> Gaussians:
    about, attributes = primitive["extensions"][_NAME], primitive["attributes"]
    packed = [name for name in about.get("extensions", {}) if "compression" in name]
    if packed:
        raise ValueError(f"{path} has its splats packed by {packed[0]}, which is not read; export it without compression")
    degree = next((d for d in (3, 2, 1) if f"{_NAME}:SH_DEGREE_{d}_COEF_0" in attributes), 0)
    names = ["POSITION", *(f"{_NAME}:{field}" for field in ("ROTATION", "SCALE", "OPACITY")), *_coefficients(degree)]
    missing = [name for name in names if name not in attributes]
    if missing:
        raise ValueError(f"{path} has splats without {', '.join(missing[:4])}")
    widths = [3, 4, 3, 1] + [3] * SH_COUNTS[degree]
    columns = [_accessor(path, tree, binary, attributes[name], width) for name, width in zip(names, widths, strict=True)]
    means, quats, scales, opacities, *coefficients = columns
    counts = {len(column) for column in columns}
    if len(counts) != 1:
        raise ValueError(f"{path} is corrupt: its attributes have {', '.join(map(str, sorted(counts)))} values")
    with np.errstate(divide="ignore", invalid="ignore"):  # what is out of range becomes inf or nan, which `validate` names
        log_scales = np.log(scales)
    sh = np.empty((len(means), len(coefficients), 3), np.float32)
    for i, coefficient in enumerate(coefficients):
        sh[:, i] = coefficient
    return assembled(means, quats[:, [3, 0, 1, 2]], log_scales, logits_from(opacities[:, 0]), sh)


def _accessor(path: Path, tree: dict, binary: np.ndarray, index: int, width: int) -> np.ndarray:
    """float32 `[count, width]`: the numbers of an accessor in the binary chunk, normalised ones as glTF says."""
    accessor = _item(tree, "accessors", index)
    if "sparse" in accessor or "bufferView" not in accessor:
        raise ValueError(f"{path}: accessor {index} is sparse or has no buffer, which is not read for splats")
    view = _item(tree, "bufferViews", accessor["bufferView"])
    kind, count = np.dtype(_TYPES[accessor["componentType"]]), accessor["count"]
    stride = view.get("byteStride", kind.itemsize * width)
    start, room = accessor.get("byteOffset", 0), view["byteLength"]
    at = view.get("byteOffset", 0)
    sizes = (count, stride, start, room, at)
    whole = all(type(v) is int and v >= 0 for v in sizes) and stride >= kind.itemsize * width and view.get("buffer") == 0
    needed = start + (count - 1) * stride + kind.itemsize * width if whole and count else 0
    if not whole or _WIDTHS[accessor["type"]] != width or needed > room or at + room > len(binary):
        raise ValueError(f"{path} is truncated or corrupt: accessor {index} claims {count} of {width} values, its view does not hold them")
    values = np.ndarray((count, width), kind, binary, at + start, (stride, kind.itemsize)) if count else np.zeros((0, width), kind)
    if kind.kind == "f":
        return values
    if not accessor.get("normalized"):
        return values.astype(np.float32)
    return np.maximum(values / np.float32(np.iinfo(kind).max), -1).astype(np.float32)
