"""PlayCanvas' SOG: lossless WebP pictures with one splat a pixel, and meta.json; a folder, or a .sog (both zipped).

means_l, means_u: the two bytes of sign(x) ln(1 + |x|) between a least and a largest. quats: three terms of wxyz as bytes of
q / sqrt(2) + 1/2, the left-out largest one as 252 + its place. scales, sh0: an entry of a table of 256 log scales or constant
coefficients a channel; opacity in sh0's alpha. shN: a label of 16 bits, an entry of a palette of up to 65536 sets of harmonics
(shN_centroids, 64 a row) whose numbers are entries of a third table. That is version 2, which is written; of version 1, which is read,
too, bytes run evenly from a least to a largest value of each channel, opacities as logits.
"""

from __future__ import annotations

import io
import json
import os
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np

from scenes.atomic import atomic_file
from scenes.formats.codebook import codebook, nearest, palette
from scenes.formats.packing import (
    BYTE_LOGITS,
    MOST_BYTES,
    assembled,
    drop_largest,
    follows,
    levels,
    opacities_from,
    parsed,
    restore_largest,
    stored,
)  # fmt: skip
from scenes.gaussians import SH_COUNTS, Gaussians

_PALETTE = 65536
_MODEL = "antialiased"
_ROW = 64  # sets of harmonics in a row of shN_centroids
_SLACK = 65536  # pixels beyond the splats, of padding


def load_sog(path: str | os.PathLike, clean: Callable[[Gaussians, str], Gaussians] = Gaussians.checked) -> Gaussians:
    """The splats of a .sog file, of a folder with meta.json, or of that meta.json. ValueError where it is not one or not whole.

    FileNotFoundError where the folder lacks a picture. `clean(gaussians, where)` answers for the values.
    """
    path = Path(path)
    if path.is_file() and path.name != "meta.json":
        with open(path, "rb") as file:
            try:
                with zipfile.ZipFile(file) as bundle:
                    inside = _folder(bundle)
                    return clean(_read(path, lambda name: _unzipped(path, bundle, inside + name)), str(path))
            # zipfile seeks where the file says, reads what it has no name for, and asks for passwords
            except (zipfile.BadZipFile, zlib.error, OSError, EOFError, NotImplementedError, RuntimeError) as error:
                raise ValueError(f"{path} is not a valid SOG file: {error}") from error
    folder = path if path.is_dir() else path.parent
    return clean(_read(path, lambda name: (folder / name).read_bytes()), str(path))


def antialiased(path: Path) -> bool:
    """Whether meta.json says that the splats were trained with antialiasing."""
    if path.is_file() and path.name != "meta.json":
        with zipfile.ZipFile(path) as bundle:
            text = _unzipped(path, bundle, _folder(bundle) + "meta.json")
    else:
        text = ((path if path.is_dir() else path.parent) / "meta.json").read_bytes()
    return parsed(path, text).get("model") == _MODEL


def save_sog(path: str | os.PathLike, gaussians: Gaussians, antialias: bool = False) -> None:
    """Write a .sog file, in the splats' order: neighbours should follow each other, for the pictures' sake. antialias: how they were
    trained.

    Positions keep 16 bits of the box; scales and colours the nearest of 256 values; harmonics the mean of about N / 65536 alike ones.
    """
    g, n, k = stored(gaussians), len(gaussians), gaussians.sh.shape[1]
    width = max(4, -(-int(np.ceil(np.sqrt(n))) // 4) * 4)
    shape = max(4, -(-n // width // 4) * 4), width
    logs = np.sign(g["means"]) * np.log1p(np.abs(g["means"].astype(np.float64)))
    least, most = (logs.min(0), logs.max(0)) if n else (np.zeros(3), np.zeros(3))
    fixed = levels((logs - least) / np.where(most > least, most - least, 1), 65535).astype(np.uint16)
    which, three = drop_largest(g["quats"])
    scales, colours = codebook(g["log_scales"]), codebook(g["sh"][:, 0])
    alphas = levels(opacities_from(g["logit_opacities"]), 255)[:, None]
    pictures = {
        "means_l": fixed & 0xFF,
        "means_u": fixed >> 8,
        "quats": np.concatenate([levels(three / 2**0.5 + 0.5, 255), 252 + which[:, None]], 1),
        "scales": nearest(scales, g["log_scales"]),
        "sh0": np.concatenate([nearest(colours, g["sh"][:, 0]), alphas], 1),
    }
    meta = {
        "version": 2, "asset": {"generator": "Sidestep"}, "count": n,
        "means": {"mins": least.tolist(), "maxs": most.tolist(), "files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": scales.tolist(), "files": ["scales.webp"]}, "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": colours.tolist(), "files": ["sh0.webp"]},
    }  # fmt: skip
    if antialias:
        meta["model"] = _MODEL
    files = {name: _webp(pixels, shape) for name, pixels in pictures.items()}
    if k > 1:
        sets, labels = palette(g["sh"][:, 1:].reshape(n, 3 * (k - 1)), _PALETTE)
        table = codebook(sets)
        rows = -(-len(sets) // _ROW) or 1
        entries = nearest(table, sets).reshape(len(sets) * (k - 1), 3)
        files["shN_centroids"] = _webp(entries, (rows, _ROW * (k - 1)))
        files["shN_labels"] = _webp(np.stack([labels & 0xFF, labels >> 8, np.zeros_like(labels)], 1), shape)
        names = ["shN_centroids.webp", "shN_labels.webp"]
        meta["shN"] = {"count": len(sets), "bands": gaussians.sh_degree, "codebook": table.tolist(), "files": names}
    with atomic_file(path) as partial, zipfile.ZipFile(partial, "w", zipfile.ZIP_STORED) as bundle:
        for name, data in files.items():
            bundle.writestr(f"{name}.webp", data)
        bundle.writestr("meta.json", json.dumps(meta, allow_nan=False))


def _read(path: Path, fetch: Callable[[str], bytes]) -> Gaussians:
    """The splats of the files that `fetch` gives by name."""
    meta = parsed(path, fetch("meta.json"))
    with follows(path, "SOG"):
        version = meta.get("version", 1)
        if version not in (1, 2):
            raise ValueError(f"{path} is SOG version {version!r}; versions 1 and 2 are read")
        n = meta["count"] if version == 2 else meta["means"]["shape"][0]
        if type(n) is not int or n < 0:
            raise ValueError(f"{path} is corrupt: its meta.json claims {n!r} splats")

        def pixels(field: str, place: int = 0) -> np.ndarray:
            """uint8 `[n, 4]`: a picture's pixels, one a splat."""
            return _picture(path, fetch, meta[field]["files"][place], n).reshape(-1, 4)[:n]

        least, most = (np.array([float(v) for v in meta["means"][end]]) for end in ("mins", "maxs"))
        if least.shape != (3,) or most.shape != (3,):
            raise ValueError(f"{path} is corrupt: its meta.json gives {len(least)} and {len(most)} ends of the positions, not 3")
        low, high = pixels("means", 0), pixels("means", 1)
        means = np.empty((n, 3), np.float32)
        with np.errstate(over="ignore", invalid="ignore"):
            logs = least + (most - least) * (np.arange(65536)[:, None] / 65535)
            places = (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)
        for i in range(3):
            means[:, i] = places[low[:, i] | high[:, i].astype(np.uint16) << 8, i]
        turns = pixels("quats")
        if (turns[:, 3] < 252).any():
            raise ValueError(f"{path} is corrupt: splat {int((turns[:, 3] < 252).argmax())} has no quaternion: its tag is below 252")
        terms = ((np.arange(256) / 255 - 0.5) * 2**0.5).astype(np.float32)
        quats = restore_largest(turns[:, 3] - 252, terms[turns.T[:3]])
        log_scales = _entries(_table(path, meta, "scales"), pixels("scales")[:, :3])
        colours, table = pixels("sh0"), _table(path, meta, "sh0")
        sh = _entries(table, colours[:, :3])[:, None]
        logits = BYTE_LOGITS[colours[:, 3]] if version == 2 else table[colours[:, 3], -1]
        if meta.get("shN"):
            sh = np.concatenate([sh, _harmonics(path, fetch, meta, pixels("shN", 1))], 1)
    return assembled(means, quats, log_scales, logits, sh)


def _harmonics(path: Path, fetch: Callable[[str], bytes], meta: dict, labels: np.ndarray) -> np.ndarray:
    """float32 `[n, K - 1, 3]`."""
    about = meta["shN"]
    bands, count = about.get("bands"), about.get("count", 0)
    if "codebook" in about and (bands not in (1, 2, 3) or type(count) is not int or not 0 <= count <= _PALETTE):
        raise ValueError(f"{path} is corrupt: its meta.json claims harmonics of {bands!r} bands, {count!r} sets")
    entries = _picture(path, fetch, about["files"][0], count * (SH_COUNTS[bands] - 1) if bands else 0)
    if not bands:  # version 1: the picture's width says, and its rows are full
        bands, count = {_ROW * (k - 1): d for d, k in enumerate(SH_COUNTS) if d}.get(entries.shape[1]), _ROW * len(entries)
    width = SH_COUNTS[bands] - 1 if bands else 0
    if not bands or entries.shape[1] != _ROW * width:
        raise ValueError(
            f"{path} is corrupt: its harmonics' picture is {entries.shape[1]} wide, which is none of {bands or '1 to 3'} bands"
        )
    sets = _entries(_table(path, meta, "shN"), entries[..., :3]).reshape(-1, width, 3)
    index = labels[:, 0].astype(np.int64) | labels[:, 1].astype(np.int64) << 8
    if len(index) and index.max() >= len(sets):
        raise ValueError(f"{path} is corrupt: splat {int(index.argmax())} has set {int(index.max())} of {len(sets)} sets of harmonics")
    return sets[index]


def _table(path: Path, meta: dict, field: str) -> np.ndarray:
    """float32 `[256, 1]`, or `[256, C]` of as many channels; entries that a short table lacks are NaN, which `validate` names."""
    about = meta[field]
    if "codebook" in about:
        values = [float(v) for v in about["codebook"]]
        if len(values) > 256:
            raise ValueError(f"{path} is corrupt: its {field} table has {len(values)} entries, a byte has 256")
        if np.isnan(values).any():
            raise ValueError(f"{path} is corrupt: entry {int(np.isnan(values).argmax())} of its {field} table is no number")
        with np.errstate(over="ignore"):
            return np.pad(np.array(values, np.float64), (0, 256 - len(values)), constant_values=np.nan).astype(np.float32)[:, None]
    ends = [about[end] if isinstance(about[end], list) else [about[end]] for end in ("mins", "maxs")]
    least, most = (np.array([float(v) for v in end]) for end in ends)
    channels = {"scales": 3, "sh0": 4, "shN": 1}[field]
    if len(least) != channels or len(most) != channels:
        raise ValueError(f"{path} is corrupt: its meta.json gives {len(least)} and {len(most)} ends of {field}, not {channels}")
    with np.errstate(over="ignore", invalid="ignore"):
        return (least + (most - least) * (np.arange(256)[:, None] / 255)).astype(np.float32)


def _entries(table: np.ndarray, places: np.ndarray) -> np.ndarray:
    """float32, of the shape of `places` `[..., 3]`: a table's entries, of each channel's own column where it has several."""
    return table[:, 0][places] if table.shape[1] == 1 else table[places, np.arange(3)]


def _picture(path: Path, fetch: Callable[[str], bytes], name: str, least: int) -> np.ndarray:
    """uint8 `[H, W, 4]` of a WebP picture with `least` pixels or some more; sizes are checked before they are believed."""
    from PIL import Image

    if not isinstance(name, str) or Path(name).name != name:
        raise ValueError(f"{path} is corrupt: {name!r} is not the name of a file beside meta.json")
    data = fetch(name)
    try:
        with Image.open(io.BytesIO(data), formats=["WEBP"]) as picture:
            width, height = picture.size
            if not least <= width * height <= min(2 * least, least + MOST_BYTES * len(data)) + _SLACK:
                raise ValueError(f"{path} is corrupt: {name} has {width}x{height} pixels for {least} entries")
            return np.array(picture.convert("RGBA"))
    except (OSError, SyntaxError, EOFError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path} is corrupt: {name} cannot be decoded: {error}") from error


def _webp(pixels: np.ndarray, shape: tuple[int, int]) -> bytes:
    """A lossless picture `[H, W]` of as many rows of `pixels` `[n, 3 or 4]` as there are, and zeros; three channels are opaque."""
    from PIL import Image

    canvas = np.zeros((shape[0] * shape[1], 4), np.uint8)
    canvas[:, 3] = 255
    canvas[: len(pixels), : pixels.shape[1]] = pixels
    out = io.BytesIO()
    # exact: colours under an alpha of 0 are splats' values like any other
    Image.fromarray(canvas.reshape(*shape, 4)).save(out, "WEBP", lossless=True, exact=True, quality=50, method=2)
    return out.getvalue()


def _folder(bundle: zipfile.ZipFile) -> str:
    """Where in a bundle its uppermost meta.json lies, as "scene/": archives made of a folder keep that; "" where it has none."""
    found = [name for name in bundle.namelist() if name.rpartition("/")[2] == "meta.json" and not name.startswith("__MACOSX/")]
    return min(found, key=lambda name: name.count("/"), default="").removesuffix("meta.json")


def _unzipped(path: Path, bundle: zipfile.ZipFile, name: str) -> bytes:
    try:
        about = bundle.getinfo(name)
    except KeyError:
        raise ValueError(f"{path} lacks {name}; it has {', '.join(bundle.namelist()[:8]) or 'no files'}") from None
    if about.file_size > MOST_BYTES * max(1, about.compress_size):
        raise ValueError(f"{path} is corrupt: {name} claims {about.file_size} bytes in {about.compress_size}")
    with bundle.open(about) as file:
        return file.read(about.file_size)
