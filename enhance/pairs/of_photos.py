"""Pairs of places that were never reconstructed: photos and frames of videos, in which a region or all is in other colours, or right."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from enhance.pairs.claims import claim
from enhance.pairs.clips import PairConfig, clip_label
from enhance.pairs.isp import alter, random_pipeline
from enhance.pairs.masks import random_mask
from enhance.pairs.shards import is_whole, to_bytes, write_shard
from enhance.photos import photos_of

STRIDE = 8
MADE = ("isp", "isp_frame", "clean")
"""Kinds of pairs of each photo."""


def make_photo_pairs(paths: Sequence[str | Path], out: str | Path, seed: int = 0, width: int = 640) -> Path:
    """Of every photo in the folders and every STRIDE-th frame of the videos `paths`, `width` pixels wide, a clip of one frame of isp,
    isp_frame and clean in the folder `out`, which is returned. Where a region is in other colours, it is told as instance 1; in clean the
    same region is told and is as it was. A run that was broken off goes on where it stopped.

    They are for measuring: training draws from photos by itself (`train(photos=...)`), so the split is "held out". ValueError where a path
    holds no photos, where two have one name, and where the folder holds pairs of others of that name or made with other settings; and for a
    `width` that PairConfig refuses.
    """
    out, config = Path(out), PairConfig(width)
    check_names(paths)
    for path in map(Path, paths):
        count, digest = 0, hashlib.sha256()
        for photo in photos_of(path, STRIDE, config.width):  # all: a pair that is there is not made again of another photo
            digest.update(photo.tobytes())
            count += 1
        claim(out, {"seed": seed, "width": config.width}, {f"source {path.stem}": f"{count} {digest.hexdigest()[:16]}"})
        for i, photo in enumerate(photos_of(path, STRIDE, config.width)):  # read again: a long video has no room in memory
            if all(is_whole(_file(out, kind, path.stem, i)) for kind in MADE):
                continue
            rng = np.random.default_rng([seed, i])
            target = torch.from_numpy(photo).permute(2, 0, 1).float() / 255
            region = torch.from_numpy(random_mask(rng, *photo.shape[:2]))[None]
            isp, everywhere = random_pipeline(rng), torch.ones_like(region)
            meta = {"split": "held out", "camera": path.stem, "start": i, "seed": seed, "instances": [1]}
            _write(out, "isp", alter(target, region, isp), target, region, region, {**meta, "isp": vars(isp)})
            _write(out, "isp_frame", isp(target), target, everywhere, everywhere, {**meta, "isp": vars(isp)})
            _write(out, "clean", target, target, region, torch.zeros_like(region), meta)
    return out


def check_names(paths: Sequence[str | Path]) -> None:
    """ValueError where two have one name, less its suffix."""
    stems = [Path(path).stem for path in paths]
    if twice := sorted({s for s in stems if stems.count(s) > 1}):
        raise ValueError(f"two of the photos' paths are called {twice[0]}, by which pairs are named; make one's in another folder")


def _write(out: Path, kind: str, given: torch.Tensor, target: torch.Tensor, told: torch.Tensor, region: torch.Tensor, meta: dict) -> None:
    _, height, width = target.shape
    tensors = {
        "input": to_bytes(given.permute(1, 2, 0))[None],
        "target": to_bytes(target.permute(1, 2, 0))[None],
        "region": to_bytes(region),
        "instance": (told > 0.5).to(torch.uint8),
        "flow": torch.full((1, height, width, 2), torch.nan, dtype=torch.float16),
        "visible": torch.zeros(1, height, width, dtype=torch.uint8),
        "depth": torch.full((1, height, width), torch.inf, dtype=torch.float16),
    }
    write_shard(_file(out, kind, meta["camera"], meta["start"]), tensors, {"kind": kind, **meta})


def _file(out: Path, kind: str, camera: str, start: int) -> Path:
    return out / kind / f"{clip_label(camera, start)}.safetensors"
