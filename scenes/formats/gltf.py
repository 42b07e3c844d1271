"""glTF 2.0's container: a GLB file's tree and binary chunk, the primitives that stand in its scene, and the numbers of accessors."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from scenes.formats.packing import parsed
from scenes.formats.transform import Z_FROM_Y_UP
from scenes.poses import matrix_from_quat

HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_TYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


def read_glb(path: Path) -> tuple[dict, np.ndarray]:
    """The JSON of a file and its binary chunk, mapped; each claimed size is checked against the file's, which may be longer."""
    size = path.stat().st_size
    with open(path, "rb") as file:
        head = file.read(HEADER.size + CHUNK.size)
        if not head.startswith(b"glTF") or len(head) < HEADER.size + CHUNK.size:
            raise ValueError(f"{path} is not a GLB file: it does not start with glTF and a chunk")
        _, version, total = HEADER.unpack_from(head)
        length, kind = CHUNK.unpack_from(head, HEADER.size)
        if version != 2 or total > size or kind != b"JSON" or len(head) + length > total:
            claims = f"its header claims glTF {version}, {total} bytes; it has {size}"
            raise ValueError(f"{path} is truncated or corrupt: {claims}; fetch or export it again")
        text = file.read(length)
        at = len(head) + length
        tail = file.read(min(CHUNK.size, total - at))
    tree = parsed(path, text)
    if len(tail) < CHUNK.size:
        return tree, np.zeros(0, np.uint8)
    length, kind = CHUNK.unpack(tail)
    if kind != b"BIN\0" or at + CHUNK.size + length > total:
        raise ValueError(f"{path} is truncated or corrupt: its second chunk claims {length} bytes of {kind!r}")
    return tree, np.memmap(path, np.uint8, "r", at + CHUNK.size, (length,)) if length else np.zeros(0, np.uint8)


def primitives(path: Path, tree: dict) -> Iterator[tuple[dict, torch.Tensor]]:
    """The scene's primitives, each with its float64 transform `[4, 4]` to Z up. A node may stand in the tree once."""
    todo = [(i, Z_FROM_Y_UP) for i in item(tree, "scenes", tree.get("scene", 0)).get("nodes", [])]
    seen = set()
    while todo:
        index, above = todo.pop()
        node = item(tree, "nodes", index)
        if index in seen:
            raise ValueError(f"{path} is corrupt: node {index} stands in its tree twice")
        seen.add(index)
        pose = above @ _transform(node)
        todo += [(child, pose) for child in node.get("children", [])]
        if "mesh" in node:
            for primitive in item(tree, "meshes", node["mesh"])["primitives"]:
                yield primitive, pose


def item(tree: dict, kind: str, index: int) -> dict:
    """An entry of one of glTF's lists; not Python's idea of index -1 or True."""
    if type(index) is not int or index < 0:
        raise KeyError(f"{kind}[{index!r}]")
    entry = tree[kind][index]
    if not isinstance(entry, dict):
        raise TypeError(f"{kind}[{index}] is no object")
    return entry


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


def view_bytes(path: Path, tree: dict, binary: np.ndarray, index: int) -> np.ndarray:
    """uint8: what a buffer view shows of the binary chunk."""
    view = item(tree, "bufferViews", index)
    at, room = view.get("byteOffset", 0), view["byteLength"]
    if any(type(v) is not int or v < 0 for v in (at, room)) or view.get("buffer") != 0 or at + room > len(binary):
        raise ValueError(
            f"{path} is truncated or corrupt: buffer view {index} claims {room!r} bytes at {at!r} of the chunk's {len(binary)}"
        )
    return binary[at : at + room]


def accessor(path: Path, tree: dict, binary: np.ndarray, index: int, width: int) -> np.ndarray:
    """float32 `[count, width]`: the numbers of an accessor in the binary chunk, normalised ones as glTF says; zeros where it has none."""
    about = item(tree, "accessors", index)
    kind, count = np.dtype(_TYPES[about["componentType"]]), about["count"]
    what = f"{path} is truncated or corrupt: accessor {index} claims {count!r} of {width} values, its view does not hold them"
    if type(count) is not int or count < 0 or WIDTHS[about["type"]] != width:
        raise ValueError(what)
    if "bufferView" in about:
        values = _table(path, tree, binary, about, kind, count, width, what)
    elif count > len(binary):  # more zeros than bytes are a lie of the header: nothing is allocated for it
        raise ValueError(what)
    else:
        values = np.zeros((count, width), kind)
    if "sparse" in about:
        sparse = about["sparse"]
        few = sparse["count"]
        if type(few) is not int or not 0 <= few <= count:
            raise ValueError(what)
        whole = np.dtype(_TYPES[sparse["indices"]["componentType"]])
        places = _table(path, tree, binary, sparse["indices"], whole, few, 1, what)[:, 0]
        if whole.kind != "u" or (few and int(places.max()) >= count):
            raise ValueError(what)
        values = values.copy()
        values[places] = _table(path, tree, binary, sparse["values"], kind, few, width, what)
    if kind.kind == "f":
        return values
    if not about.get("normalized"):
        return values.astype(np.float32)
    return np.maximum(values / np.float32(np.iinfo(kind).max), -1).astype(np.float32)


def _table(path: Path, tree: dict, binary: np.ndarray, about: dict, kind: np.dtype, count: int, width: int, what: str) -> np.ndarray:
    """`[count, width]` of a type, mapped: what `about` (bufferView, byteOffset) places in a view; ValueError `what` where it is beyond."""
    data = view_bytes(path, tree, binary, about["bufferView"])
    size = kind.itemsize * width
    stride, start = item(tree, "bufferViews", about["bufferView"]).get("byteStride", size), about.get("byteOffset", 0)
    if (
        any(type(v) is not int or v < 0 for v in (stride, start))
        or stride < size
        or (count and start + (count - 1) * stride + size > len(data))
    ):
        raise ValueError(what)
    return np.ndarray((count, width), kind, data, start, (stride, kind.itemsize)) if count else np.zeros((0, width), kind)
