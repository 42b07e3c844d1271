"""antimatter15's .splat: 32 bytes a splat, no header. Position and linear scale float32, RGBA bytes, quaternion wxyz bytes about 128.

Harmonics above the constant have no place in it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np

from scenes.atomic import atomic_file
from scenes.formats.packing import BYTE_LOGITS, assembled, levels, log_scales_from, opacities_from, scales_from, stored, unit
from scenes.gaussians import Gaussians
from scenes.harmonics import rgb_from_sh, sh_from_rgb

_RECORD = np.dtype([("means", "<f4", 3), ("scales", "<f4", 3), ("rgba", "u1", 4), ("quats", "u1", 4)])


def load_splat(path: str | os.PathLike, clean: Callable[[Gaussians, str], Gaussians] = Gaussians.checked) -> Gaussians:
    """The splats of a .splat file. ValueError where its size is not a whole number of records; `clean` answers for the values."""
    path = Path(path)
    size = path.stat().st_size
    if size % _RECORD.itemsize:
        raise ValueError(f"{path} is not a valid .splat file: its {size} bytes are not a multiple of {_RECORD.itemsize}")
    records = np.memmap(path, _RECORD, "r") if size else np.zeros(0, _RECORD)
    log_scales = log_scales_from(records["scales"])
    rgba = records["rgba"]
    sh = sh_from_rgb(rgba[:, None, :3].astype(np.float32) / 255)
    quats = (records["quats"].astype(np.float32) - 128) / 128
    return clean(assembled(records["means"], quats, log_scales, BYTE_LOGITS[rgba[:, 3]], sh), str(path))


def save_splat(path: str | os.PathLike, gaussians: Gaussians) -> None:
    """Write splats: positions bit for bit, scales within 1 ulp, the rest in bytes, harmonics above the constant left out."""
    g = stored(gaussians)
    records = np.zeros(len(gaussians), _RECORD)
    records["means"] = g["means"]
    records["scales"] = scales_from(g["log_scales"])
    records["rgba"][:, :3] = levels(rgb_from_sh(g["sh"][:, 0]), 255)
    records["rgba"][:, 3] = levels(opacities_from(g["logit_opacities"]), 255)
    records["quats"] = np.rint(unit(g["quats"]) * 128 + 128).clip(0, 255)
    with atomic_file(path) as partial, open(partial, "wb") as file:
        file.write(records.view(np.uint8).data)  # not by numpy, which does not say that the disk is full
