"""3D Gaussian splat PLY files, as Kerbl et al.'s code writes them and every other tool reads them.

x y z, nx ny nz (zeros), f_dc_0..2, f_rest_* (channel-major: all of red's, all of green's, all of blue's), opacity (logit),
scale_0..2 (ln), rot_0..3 (wxyz); binary little-endian floats. The reader takes any order, number type and byte order, more
properties and ASCII, and what other tools write: red, green, blue instead of f_dc (nerfstudio), no scale_2 (2D splats), harmonics of
degree 4 (Brush; those of degree 3 are kept), filter_3D (Mip-Splatting and what builds on it), logits and scales of 0 and 1 that are
infinite. Positions in doubles are refused where floats, which splats are, would move them: those of a map's coordinates. It maps the
file: what the header claims is checked against its size before anything is allocated.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from scenes.atomic import atomic_file
from scenes.formats.packing import FLAT, LOGIT_LIMIT, kept_harmonics, logits_from, opacities_from
from scenes.gaussians import SH_COUNTS, Gaussians
from scenes.harmonics import sh_from_rgb

_MAX_HEADER = 1 << 20
_ROWS = 4096
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_FORMATS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": "="}
_FIELDS = {
    "means": ("x", "y", "z"),
    "dc": ("f_dc_0", "f_dc_1", "f_dc_2"),
    "opacity": ("opacity",),
    "scales": ("scale_0", "scale_1", "scale_2"),
    "quats": ("rot_0", "rot_1", "rot_2", "rot_3"),
}
_RGB = ("red", "green", "blue")
_FULL = {"u1": 255.0, "u2": 65535.0}
_FILTER = "filter_3D"
_ASTRAY = 0.01
"""Units by which floats may move a position that a file gives in doubles."""
ANTIALIASED = "comment SplatRenderMode: mip"
_REST_COUNTS = [3 * (k - 1) for k in (*SH_COUNTS, 25)]


@dataclass
class Element:
    """An element of the header: how many records, and each property's name and numpy type ("list" for lists)."""

    name: str
    count: int
    properties: dict[str, str]


def load_ply(path: str | os.PathLike, clean: Callable[[Gaussians, str], Gaussians] = Gaussians.checked) -> Gaussians:
    """The splats of a 3DGS PLY file, bit for bit where they are finite. ValueError where it is not one or not whole.

    `clean(gaussians, where)` answers for the values: by default those that are not finite are refused by splat and field.
    """
    path = Path(path)
    order, elements, offset = read_header(path)
    fields, rest = _check_splats(path, elements)
    vertices = _read_vertices(path, order, elements, offset)
    n, k = len(vertices), kept_harmonics(1 + rest // 3, path)
    finer = "f8" in {next(e.properties[axis] for e in elements if e.name == "vertex") for axis in fields["means"]}
    values = {name: np.empty((n, len(names)), np.float32) for name, names in fields.items() if name not in ("dc", "rgb")}
    sh, higher = np.empty((n, k, 3), np.float32), [f"f_rest_{i}" for i in range(rest)]
    for start in range(0, n, _ROWS):  # one pass over the file, in parts that stay in the processor's cache
        rows, part = slice(start, start + _ROWS), vertices[start : start + _ROWS]
        for name, value in values.items():
            value[rows] = _columns(part, fields[name])
        if finer:
            _check_rounded(path, part, values["means"][rows])
        sh[rows, 0] = _columns(part, fields["dc"]) if "dc" in fields else _constants(part, elements)
        sh[rows, 1:] = _columns(part, higher).reshape(len(part), 3, rest // 3).transpose(0, 2, 1)[:, : k - 1]
    logits, scales = values["opacity"][:, 0], values["scales"]
    if scales.shape[1] == 2:
        scales = np.concatenate([scales, np.full((n, 1), FLAT, np.float32)], 1)
    scales[scales == -np.inf] = FLAT
    logits[np.isinf(logits)] = LOGIT_LIMIT * np.sign(logits[np.isinf(logits)])
    if "filter" in values:
        scales, logits = _filtered(scales, logits, values["filter"])
    parts = values["means"], values["quats"], scales, logits, sh
    return clean(Gaussians(*(torch.from_numpy(np.ascontiguousarray(f)) for f in parts)), str(path))


def _check_rounded(path: Path, part: np.ndarray, means: np.ndarray) -> None:
    """ValueError where positions `[N, 3]` of records that hold doubles lost what tells neighbours apart."""
    for axis, name in enumerate(("x", "y", "z")):
        with np.errstate(invalid="ignore"):  # what is not finite is refused by others, or left out
            astray = np.abs(part[name] - means[:, axis])
        astray[~np.isfinite(astray)] = 0
        if len(part) and astray.max() > _ASTRAY:
            far = part[name][astray.argmax()]
            lost = f"{path} has a splat at {name} = {far:.12g}, which 32 bits, as splats have, would move by {astray.max():.2g}"
            raise ValueError(f"{lost}; take a round number, as {np.round(far, -5):.12g}, from the {name} of all, and give that file")


def _constants(part: np.ndarray, elements: list[Element]) -> np.ndarray:
    """float32 `[N, 3]`: the constant coefficients of the colours red, green and blue, whole numbers up to their type's largest."""
    kinds = next(e.properties for e in elements if e.name == "vertex")
    rgb = _columns(part, _RGB) / np.array([_FULL.get(kinds[name], 1.0) for name in _RGB])
    return sh_from_rgb(rgb).astype(np.float32)


def _filtered(log_scales: np.ndarray, logits: np.ndarray, sigma: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Log scales and logits of splats that were rendered through Mip-Splatting's 3D filter (Yu et al. 2024), its sigma `[N, 1]` apart."""
    before = 2 * log_scales.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        after = np.logaddexp(before, 2 * np.log(sigma.astype(np.float64)))
    thinner = np.exp((before - after).sum(1) / 2)
    return (after / 2).astype(np.float32), logits_from(opacities_from(logits) * thinner)


def save_ply(path: str | os.PathLike, gaussians: Gaussians, antialias: bool = False) -> None:
    """Write splats as Kerbl et al.'s code does, and with Brush's comment where they were trained with antialiasing. Reading them back is
    bit-equal."""
    n, k, _ = gaussians.sh.shape
    g = gaussians.detach().to("cpu")
    rest = [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names = ["x", "y", "z", "nx", "ny", "nz", *_FIELDS["dc"], *rest, "opacity", *_FIELDS["scales"], *_FIELDS["quats"]]
    higher = g.sh[:, 1:].transpose(1, 2).reshape(n, 3 * (k - 1))
    parts = [g.means, torch.zeros(n, 3), g.sh[:, 0], higher, g.logit_opacities[:, None], g.log_scales, g.quats]
    about = [ANTIALIASED] if antialias else []
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *about,
        f"element vertex {n}",
        *(f"property float {name}" for name in names),
        "end_header",
    ]
    with atomic_file(path) as partial, open(partial, "wb") as file:
        file.write(("\n".join(header) + "\n").encode("ascii"))
        file.write(torch.cat(parts, 1).numpy().astype("<f4", copy=False).data)


def last_comment(path: Path, pattern: re.Pattern[bytes]) -> bytes | None:
    """What the last comment line of a whole file says that a pattern of one group finds; None where none does."""
    with open(path, "rb") as file:
        said = pattern.findall(file.read(1 << 16).partition(b"\nend_header")[0])
    return said[-1] if said else None


def read_header(path: Path) -> tuple[str, list[Element], int]:
    """Byte order, elements, and where the data starts."""
    with open(path, "rb") as file:
        head = file.read(_MAX_HEADER)
    if not head.startswith((b"ply\n", b"ply\r\n")):
        raise ValueError(f"{path} is not a PLY file: it does not start with the line ply")
    end = head.find(b"\nend_header") + 1  # a line of its own: comments may hold the word
    stop = head.find(b"\n", end)
    if end < 1 or stop < 0:
        raise ValueError(f"{path} is truncated or corrupt: its header has no end_header")
    order, elements = None, []
    for number, line in enumerate(head[:end].decode("latin-1").splitlines()[1:], 2):
        words = line.split()
        try:
            match words:
                case [] | ["comment" | "obj_info", *_]:
                    pass
                case ["format", kind, "1.0"]:
                    order = _FORMATS[kind]
                case ["element", name, count] if count.isdigit():
                    elements.append(Element(name, int(count), {}))
                case ["property", "list", _, _, name]:
                    _add_property(elements, name, "list")
                case ["property", kind, name]:
                    _add_property(elements, name, _TYPES[kind])
                case _:
                    raise KeyError(line)
        except (KeyError, IndexError) as error:
            raise ValueError(f"{path}: line {number} of the header is not PLY 1.0: {line[:60]!r}") from error
    if order is None:
        raise ValueError(f"{path}: the header has no format line")
    return order, elements, stop + 1


def _add_property(elements: list[Element], name: str, kind: str) -> None:
    if name in elements[-1].properties:
        raise KeyError(name)
    elements[-1].properties[name] = kind


def _check_splats(path: Path, elements: list[Element]) -> tuple[dict[str, tuple[str, ...]], int]:
    """The properties of each field, and the number of f_rest; ValueError saying what the file is instead where it holds no splats."""
    names = {e.name: e.properties for e in elements}
    vertex = names.get("vertex", {})
    if "packed_position" in vertex:
        raise ValueError(f"{path} is a compressed splat PLY (PlayCanvas, SuperSplat); scenes.load reads it, by its header")
    has = {name for name, kind in vertex.items() if kind != "list"}
    fields = dict(_FIELDS)
    if has.isdisjoint(fields["dc"]) and has.issuperset(_RGB):
        fields["rgb"] = _RGB
        del fields["dc"]
    if "scale_2" not in vertex:
        fields["scales"] = fields["scales"][:2]
    missing = [name for group in fields.values() for name in group if name not in has]
    if missing:
        what = "a mesh" if "face" in names else "not a Gaussian splat file"
        raise ValueError(f"{path} is {what}: its vertices lack {', '.join(missing)}")
    if _FILTER in has:
        fields["filter"] = (_FILTER,)
    rest = [name for name in vertex if name.startswith("f_rest_")]
    if len(rest) not in _REST_COUNTS or any(f"f_rest_{i}" not in has for i in range(len(rest))):
        raise ValueError(f"{path} has {len(rest)} f_rest properties; SH of degree 0 to 4 has f_rest_0 to f_rest_8, 23, 44 or 71, or none")
    return fields, len(rest)


def _read_vertices(path: Path, order: str, elements: list[Element], offset: int) -> np.ndarray:
    """The vertex records as a structured array, mapped from the file where it is binary."""
    at = next(i for i, e in enumerate(elements) if e.name == "vertex")
    vertex, before, last = elements[at], elements[:at], at == len(elements) - 1
    if any("list" in e.properties.values() for e in [*before, vertex]):
        raise ValueError(f"{path} has list properties before or in its vertices, which is not a Gaussian splat file's layout")
    if order == "=":
        return _read_ascii(path, vertex, sum(e.count for e in before), last, offset)
    kind = record(vertex, order)
    start = offset + sum(e.count * record(e, order).itemsize for e in before)
    stop, size = start + vertex.count * kind.itemsize, path.stat().st_size
    if stop > size:
        raise ValueError(f"{path} is truncated: its header claims {vertex.count} splats, {stop} bytes in all, but it has {size}")
    if last and stop < size:
        raise ValueError(f"{path} is corrupt: its header claims {vertex.count} splats, {stop} bytes in all, but it has {size}")
    return np.memmap(path, kind, "r", start, (vertex.count,)) if vertex.count else np.zeros(0, kind)


def _read_ascii(path: Path, vertex: Element, skip: int, last: bool, offset: int) -> np.ndarray:
    with open(path, "rb") as file:
        file.seek(offset)
        lines = file.read().split(b"\n")
    lines = [line for line in lines if line.strip()][skip:]
    if len(lines) < vertex.count or (last and len(lines) > vertex.count):
        raise ValueError(f"{path} is truncated or corrupt: its header claims {vertex.count} splats, but it has {len(lines)} lines of them")
    rows = [line.split() for line in lines[: vertex.count]]
    wrong = next((i for i, row in enumerate(rows) if len(row) != len(vertex.properties)), None)
    if wrong is not None:
        raise ValueError(f"{path} is corrupt: splat {wrong} has {len(rows[wrong])} values for {len(vertex.properties)} properties")
    try:
        values = np.array(rows, np.float64).reshape(vertex.count, len(vertex.properties))
    except ValueError as error:
        raise ValueError(f"{path} is corrupt: {error}") from error
    return np.rec.fromarrays(list(values.T), dtype=np.dtype([(name, "f8") for name in vertex.properties]))


def record(element: Element, order: str) -> np.dtype:
    return np.dtype([(name, order + kind) for name, kind in element.properties.items()])


def _columns(vertices: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """float32 `[N, len(names)]`."""
    have = list(vertices.dtype.names or ())
    kinds = {vertices.dtype[name] for name in have}
    first = have.index(names[0]) if names else 0
    with np.errstate(over="ignore"):  # a double beyond float32 becomes inf, which `validate` names
        if len(kinds) == 1 and have[first : first + len(names)] == list(names):  # as all tools write: one block of a plain table
            table = vertices.view(kinds.pop()).reshape(len(vertices), len(have))
            return table[:, first : first + len(names)].astype(np.float32)
        out = np.empty((len(vertices), len(names)), np.float32)
        for i, name in enumerate(names):
            out[:, i] = vertices[name]
    return out
