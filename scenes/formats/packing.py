"""What packed splat formats share: opacities in a byte, quaternions without their largest term, an order that keeps neighbours together."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import torch

from scenes.gaussians import SH_COUNTS, Gaussians
from scenes.warnings import warn

LOGIT_LIMIT = 15.0  # opacities of 0 and 1 have no finite logit; here they are this far from it
FLAT = -13.8  # log scale of an axis along which a splat has no extent at all: a micrometre
MOST_BYTES = 1024  # unpacked bytes for each byte of a compressed file: more is a lie of the header, or a bomb


def kept_harmonics(count: int, path: str | os.PathLike) -> int:
    """How many of a splat's `count` harmonics are kept, those of degree 3 at most; a warning where a file has more."""
    if count > SH_COUNTS[-1]:
        warn([f"{path} has harmonics of degree {math.isqrt(count) - 1}; those beyond degree {len(SH_COUNTS) - 1} are left out"])
    return min(count, SH_COUNTS[-1])


def opacities_from(logits: np.ndarray) -> np.ndarray:
    """float64 opacities, never quite 0 or 1."""
    return 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -LOGIT_LIMIT, LOGIT_LIMIT)))


def logits_from(opacities: np.ndarray) -> np.ndarray:
    """float32 logits of linear opacities, within the limit; NaN where an opacity is outside 0 to 1, which `validate` names."""
    with np.errstate(divide="ignore", invalid="ignore"):
        p = opacities.astype(np.float64)
        return np.clip(np.log(p) - np.log1p(-p), -LOGIT_LIMIT, LOGIT_LIMIT).astype(np.float32)


def log_scales_from(scales: np.ndarray) -> np.ndarray:
    """float32 logarithms of linear scales, those of 0 as of a micrometre; NaN where a scale is negative, which `validate` names."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(scales == 0, FLAT, np.log(scales)).astype(np.float32)


def scales_from(log_scales: np.ndarray, kind: str = "f4") -> np.ndarray:
    """float64 linear scales, held within what a kind of float has, full or half."""
    with np.errstate(over="ignore"):
        return np.exp(log_scales.astype(np.float64)).clip(np.finfo(kind).tiny, np.finfo(kind).max)


BYTE_LOGITS = logits_from(np.arange(256) / 255)


def stored(gaussians: Gaussians) -> dict[str, np.ndarray]:
    """The five fields by name as float32 arrays on the CPU."""
    return {name: t.detach().cpu().numpy() for name, t in gaussians.tensors().items()}


def assembled(means: np.ndarray, quats: np.ndarray, log_scales: np.ndarray, logits: np.ndarray, sh: np.ndarray) -> Gaussians:
    """Splats of arrays of any float type. What is beyond float32 becomes infinite, which `validate` names."""
    with np.errstate(over="ignore"):
        fields = [np.ascontiguousarray(f, np.float32) for f in (means, quats, log_scales, logits, sh)]
    return Gaussians(*(torch.from_numpy(f if f.flags.writeable else f.copy()) for f in fields))


def unit(quats: np.ndarray) -> np.ndarray:
    """float64 quaternions of length one; scaled by the largest term first, so that denormal ones keep their direction."""
    quats = quats.astype(np.float64)
    quats /= np.abs(quats).max(1, keepdims=True)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def drop_largest(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Which term `[N]` of each quaternion `[N, 4]` is largest, and the other three `[N, 3]`, signed as if that one were positive."""
    quats = unit(quats)
    which = np.abs(quats).argmax(1)
    quats *= np.where(np.take_along_axis(quats, which[:, None], 1) < 0, -1, 1)
    return which, quats[np.arange(4) != which[:, None]].reshape(-1, 3)


def restore_largest(which: np.ndarray, three: np.ndarray) -> np.ndarray:
    """float32 quaternions `[N, 4]` of length one from which term is left out `[N]` and the others, columns `[3, N]` in their order."""
    quats = np.empty((len(which), 4), np.float32)
    largest = np.sqrt(np.maximum(0, 1 - three[0] * three[0] - three[1] * three[1] - three[2] * three[2]))
    for term in range(4):
        before, after = three[min(term, 2)], three[max(term - 1, 0)]
        quats[:, term] = np.where(which == term, largest, np.where(which > term, before, after))
    return quats


def levels(values: np.ndarray, top: int) -> np.ndarray:
    """Values from 0 to 1 as whole numbers (float) from 0 to `top`, rounded and clipped; 0 for what is no number."""
    return np.rint(np.nan_to_num(values).clip(0, 1) * top)


def morton_order(means: torch.Tensor) -> torch.Tensor:
    """Indices `[N]` that sort positions `[N, 3]` along a Z curve of 2^16 cells an axis (Morton 1966)."""
    if not len(means):
        return torch.zeros(0, dtype=torch.int64)
    places = means.detach().cpu().double()
    low, high = places.amin(0), places.amax(0)
    cells = ((places - low) / (high - low).clamp_min(1e-30) * 65535).to(torch.int64)
    for shift, mask in ((16, 0xFF0000FF), (8, 0x00F00F00F00F), (4, 0x0C30C30C30C3), (2, 0x249249249249)):
        cells = (cells | cells << shift) & mask
    return torch.argsort(cells[:, 0] | cells[:, 1] << 1 | cells[:, 2] << 2, stable=True)


@contextmanager
def follows(path: Path, what: str) -> Iterator[None]:
    """Turn what goes wrong while a foreign header is followed into a ValueError that names the file."""
    try:
        yield
    except (LookupError, TypeError, AttributeError, ArithmeticError, RecursionError) as error:
        raise ValueError(f"{path} is corrupt: it does not hold what {what} says ({type(error).__name__}: {error})") from error


def parsed(path: Path, text: bytes) -> dict:
    """The JSON object of a foreign file; ValueError where it is none."""
    try:
        tree = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path} is corrupt: its JSON cannot be read: {error}") from error
    if not isinstance(tree, dict):
        raise ValueError(f"{path} is corrupt: its JSON is no object")
    return tree
