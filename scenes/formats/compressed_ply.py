"""PlayCanvas' compressed PLY (SuperSplat, splat-transform): 16 bytes a splat in chunks of 256 that share ranges of values.

Element chunk: the least and the largest position, log scale and colour (older files: no colour, it runs from 0 to 1). Element vertex,
uint32 each: packed_position and packed_scale 11, 10, 11 bits between those; packed_rotation the largest of wxyz, 2 bits, then the other
three, 10 bits each, as q / sqrt(2) + 1/2; packed_color RGB between the chunk's colours and the opacity, 8 bits each. Element sh, if any:
f_rest_* in PLY's order, bytes from -4 to 4.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from scenes.atomic import atomic_file
from scenes.formats.packing import BYTE_LOGITS, assembled, drop_largest, levels, opacities_from, restore_largest, stored
from scenes.formats.ply import ANTIALIASED, Element, read_header, record
from scenes.gaussians import SH_COUNTS, Gaussians
from scenes.harmonics import rgb_from_sh, sh_from_rgb

_CHUNK = 256
_RANGES = [f"{end}_{value}" for kind in ("", "scale_") for end in ("min", "max") for value in (kind + "x", kind + "y", kind + "z")]
_COLOURS = [f"{end}_{channel}" for end in ("min", "max") for channel in "rgb"]
_PACKED = ["packed_position", "packed_rotation", "packed_scale", "packed_color"]
_111011, _101010, _8888 = ((21, 11), (11, 10), (0, 11)), ((20, 10), (10, 10), (0, 10)), ((24, 8), (16, 8), (8, 8), (0, 8))
_LARGEST_LOG_SCALE = 20.0
_UNPACKED_SH = ((np.arange(256) + 0.5) / 256 * 8 - 4).astype(np.float32)
_UNPACKED_SH[[0, 255]] = -4, 4


def load_compressed_ply(path: str | os.PathLike, clean: Callable[[Gaussians, str], Gaussians] = Gaussians.checked) -> Gaussians:
    """The splats of a compressed PLY file. ValueError where it is not one or not whole; `clean` answers for the values."""
    path = Path(path)
    chunks, vertices, rest = _tables(path)
    n = len(vertices)

    def between(at: int, shares: np.ndarray) -> np.ndarray:
        """float32 `[n, 3]`: values at shares `[3, n]` of their chunks' ranges, which begin at a column of those."""
        values = np.empty((n, 3), np.float32)
        with np.errstate(invalid="ignore", over="ignore"):
            for i, share in enumerate(shares):
                least, most = (np.repeat(chunks[:, column], _CHUNK)[:n] for column in (at + i, at + 3 + i))
                values[:, i] = least * (1 - share) + most * share
        return values

    position, rotation, scale, colour = (np.ascontiguousarray(vertices[:, i]) for i in range(4))
    quats = restore_largest(rotation >> 30, (_fields(rotation, _101010) - np.float32(0.5)) * np.float32(2**0.5))
    sh = np.empty((n, 1 + rest.shape[1] // 3, 3), np.float32)
    sh[:, 0] = sh_from_rgb(between(12, _fields(colour, _8888[:3])))
    sh[:, 1:] = _UNPACKED_SH[rest].reshape(n, 3, rest.shape[1] // 3).transpose(0, 2, 1)
    means, log_scales = between(0, _fields(position, _111011)), between(6, _fields(scale, _111011))
    return clean(assembled(means, quats, log_scales, BYTE_LOGITS[colour & 0xFF], sh), str(path))


def save_compressed_ply(path: str | os.PathLike, gaussians: Gaussians, antialias: bool = False) -> None:
    """Write splats in their order: neighbours should follow each other, since a chunk's range sets the error of its positions.
    antialias: how they were trained."""
    n, k = len(gaussians), gaussians.sh.shape[1]
    g = stored(gaussians)
    colours = rgb_from_sh(g["sh"][:, 0])
    values = {"position": g["means"], "scale": g["log_scales"].clip(-_LARGEST_LOG_SCALE, _LARGEST_LOG_SCALE), "color": colours}
    starts = np.arange(0, n, _CHUNK)
    ends = {name: [f(v, starts, axis=0) if n else v for f in (np.minimum.reduceat, np.maximum.reduceat)] for name, v in values.items()}

    def share(name: str) -> np.ndarray:
        """float64 `[n, 3]` from 0 to 1: where in its chunk's range a value lies."""
        least, most = (np.repeat(end, _CHUNK, 0)[:n].astype(np.float64) for end in ends[name])
        return (values[name] - least) / np.where(most > least, most - least, 1)

    which, three = drop_largest(g["quats"])
    packed = np.empty((n, 4), "<u4")
    packed[:, 0], packed[:, 2] = (_packed(share(name), _111011) for name in ("position", "scale"))
    packed[:, 1] = which.astype(np.uint32) << 30 | _packed(three / 2**0.5 + 0.5, _101010)
    rgba = np.concatenate([share("color"), opacities_from(g["logit_opacities"])[:, None]], 1)
    packed[:, 3] = _packed(rgba, _8888)
    rest = np.floor((g["sh"][:, 1:].transpose(0, 2, 1).reshape(n, 3 * (k - 1)) / 8 + 0.5) * 256).clip(0, 255).astype(np.uint8)
    header = ["ply", "format binary_little_endian 1.0", *([ANTIALIASED] if antialias else []), f"element chunk {len(starts)}"]
    header += [f"property float {name}" for name in _RANGES + _COLOURS]
    header += [f"element vertex {n}", *(f"property uint {name}" for name in _PACKED)]
    header += [f"element sh {n}", *(f"property uchar f_rest_{i}" for i in range(3 * (k - 1)))] if k > 1 else []
    with atomic_file(path) as partial, open(partial, "wb") as file:
        file.write(("\n".join([*header, "end_header"]) + "\n").encode("ascii"))
        for table in (np.concatenate([end for pair in ends.values() for end in pair], 1).astype("<f4"), packed, rest):
            file.write(table.tobytes())


def _fields(words: np.ndarray, places: tuple[tuple[int, int], ...]) -> np.ndarray:
    """float32 `[len(places), n]` from 0 to 1: the fields of uint32 `[n]` at (shift, width)."""
    return np.stack([(words >> shift & (1 << width) - 1) / np.float32((1 << width) - 1) for shift, width in places])


def _packed(values: np.ndarray, places: tuple[tuple[int, int], ...]) -> np.ndarray:
    """uint32 `[n]`: values `[n, len(places)]` from 0 to 1, each rounded to its field."""
    fields = [levels(values[:, i], (1 << width) - 1).astype(np.uint32) << shift for i, (shift, width) in enumerate(places)]
    return np.bitwise_or.reduce(fields)


def _tables(path: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ranges float32 `[chunks, 18]`, packed splats uint32 `[n, 4]` and harmonics uint8 `[n, 3 (K - 1)]`, mapped from the file."""
    order, elements, offset = read_header(path)
    layout = {e.name: list(e.properties.items()) for e in elements}
    sh_counts = [3 * (k - 1) for k in SH_COUNTS]
    rest = layout.get("sh", [])
    known = (
        order == "<"
        and list(layout) in (["chunk", "vertex"], ["chunk", "vertex", "sh"])
        and layout["chunk"] in ([(name, "f4") for name in _RANGES], [(name, "f4") for name in _RANGES + _COLOURS])
        and layout["vertex"] == [(name, "u4") for name in _PACKED]
        and (len(rest) in sh_counts and rest == [(f"f_rest_{i}", "u1") for i in range(len(rest))])
    )
    if not known:
        raise ValueError(f"{path} is not a compressed splat PLY of a layout that PlayCanvas' tools write: elements {', '.join(layout)}")
    chunk, vertex, *sh = elements
    if chunk.count != -(-vertex.count // _CHUNK) or any(e.count != vertex.count for e in sh):
        counts = ", ".join(f"{e.count} {e.name}" for e in elements)
        raise ValueError(f"{path} is corrupt: its header claims {counts}; there must be one chunk for {_CHUNK} splats")
    stop, size = offset + sum(e.count * record(e, "<").itemsize for e in elements), path.stat().st_size
    if stop != size:
        what = "truncated" if stop > size else "corrupt"
        raise ValueError(f"{path} is {what}: its header claims {vertex.count} splats, {stop} bytes in all, but it has {size}")
    tables = []
    for element in elements:
        tables.append(_mapped(path, element, offset))
        offset += element.count * record(element, "<").itemsize
    ranges, packed = tables[:2]
    if ranges.shape[1] == len(_RANGES):
        whole = np.repeat(np.array([[0, 0, 0, 1, 1, 1]], np.float32), len(ranges), 0)
        ranges = np.concatenate([ranges, whole], 1)
    return ranges, packed, tables[2] if sh else np.zeros((vertex.count, 0), np.uint8)


def _mapped(path: Path, element: Element, offset: int) -> np.ndarray:
    """The records of an element whose properties are of one type, `[count, properties]`."""
    kind, shape = "<" + next(iter(element.properties.values())), (element.count, len(element.properties))
    return np.memmap(path, kind, "r", offset, shape) if element.count else np.zeros(shape, kind)
