"""Pairs on disk: one safetensors file a clip with a json file beside it, read by crops without loading the whole.

`<folder>/<kind>/<name>.safetensors` holds, for a clip of T consecutive frames of one camera:

input     uint8 `[T, H, W, 3]`    the damaged frames
target    uint8 `[T, H, W, 3]`    what they should be
region    uint8 `[T, H, W]`       where they were damaged, 0..255
instance  uint8 `[T, H, W]`       rendered instance id, 255 where none; 1 throughout where the whole frame is in other colours
flow      float16 `[T, H, W, 2]`  exact flow to the previous frame, pixels; NaN in the first frame and where unknown
visible   uint8 `[T, H, W]`       1 where the previous frame shows the same point
depth     float16 `[T, H, W]`     z in metres, inf where nothing is (clips made before it was kept lack it)

and, of rendered frames whose scene has photos, and of assets put back that have some,

reference uint8 `[T, H, W, 3]`    what those say of the view (`render.references`), never the target itself
trust     uint8 `[T, H, W]`       how far to go there from the input, 0..255

and `<name>.json` says kind, split ("train" or "held out"), camera, times, seed and what was done.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import torch

from scenes.atomic import atomic_file, made_folder
from scenes.checks import check_tensor

KINDS = ("underfit", "isp", "clean", "sparse", "cycle", "crossref", "relight", "shadow", "reinsert", "isp_frame")
NOTE = "pairs.json"
"""In a folder of pairs: how they are made, and of what."""
RENDERED = ("underfit", "sparse", "cycle", "crossref")
"""Kinds whose whole frame comes from a reconstruction."""
FIELDS = {
    "input": torch.uint8,
    "target": torch.uint8,
    "region": torch.uint8,
    "instance": torch.uint8,
    "flow": torch.float16,
    "visible": torch.uint8,
}
STORED = FIELDS | {"depth": torch.float16}
REFERENCES = {"reference": torch.uint8, "trust": torch.uint8}


@dataclass(frozen=True)
class Window:
    """A crop in space and time of a clip, as float32 tensors ready for the network.

    input, target  `[T, 3, h, w]` in 0..1
    region         `[T, 1, h, w]` in 0..1
    instance       `[T, 1, h, w]` int16, -1 where none
    flow           `[T, 2, h, w]` pixels to the previous frame, NaN where unknown
    visible        `[T, 1, h, w]` 0 or 1
    reference      `[T, 3, h, w]` in 0..1; the input where there is none
    trust          `[T, 1, h, w]` in 0..1; 0 where there is none
    """

    input: torch.Tensor
    target: torch.Tensor
    region: torch.Tensor
    instance: torch.Tensor
    flow: torch.Tensor
    visible: torch.Tensor
    reference: torch.Tensor
    trust: torch.Tensor


@dataclass(frozen=True)
class Shard:
    """One stored clip: where it is, its size, and its metadata."""

    path: Path
    frames: int
    height: int
    width: int
    meta: dict

    def window(
        self, start: int = 0, frames: int | None = None, top: int = 0, left: int = 0, height: int | None = None, width: int | None = None
    ) -> Window:
        """A part of the clip; only what is asked for is read from disk."""
        t = slice(start, start + (frames or self.frames - start))
        y, x = slice(top, top + (height or self.height - top)), slice(left, left + (width or self.width - left))
        with self._open() as file:
            known = FIELDS | (REFERENCES if "trust" in file.keys() else {})  # noqa: SIM118 - not a dict
            part = {name: file.get_slice(name)[t, y, x] for name in known}
        part = {"reference": part["input"], "trust": torch.zeros_like(part["region"])} | part
        colour = {name: part[name].permute(0, 3, 1, 2).float() / 255 for name in ("input", "target", "reference")}
        instance = part["instance"][:, None].to(torch.int16)
        flow = part["flow"].permute(0, 3, 1, 2).float()
        flow[0] = torch.nan  # the frame before the window is not part of it
        visible = part["visible"][:, None].float()
        visible[0] = 0
        return Window(
            **colour,
            region=part["region"][:, None].float() / 255,
            instance=torch.where(instance == 255, -1, instance),
            flow=flow,
            visible=visible,
            trust=part["trust"][:, None].float() / 255,
        )

    @property
    def referenced(self) -> bool:
        """Whether photos say something of its frames."""
        with self._open() as file:
            return "trust" in file.keys()  # noqa: SIM118 - not a dict

    def changed(self, index: int) -> torch.Tensor:
        """Where a frame was damaged, bool `[H, W]`."""
        with self._open() as file:
            return file.get_slice("region")[index] > 127

    def frame(self, which: str, index: int) -> tuple[torch.Tensor, torch.Tensor]:
        """One "input" or "target" as stored, uint8 `[H, W, 3]`, and its instances `[H, W]`."""
        with self._open() as file:
            return file.get_slice(which)[index], file.get_slice("instance")[index]

    @contextmanager
    def _open(self) -> Iterator[Any]:
        """The clip's file; ValueError where it is damaged, or another clip than its description says."""
        from safetensors import SafetensorError, safe_open

        fix = f"delete {self.path.with_suffix('.json').name} beside it and run sidestep pairs again"
        try:
            with safe_open(self.path, "pt") as file:
                shape = tuple(file.get_slice("region").get_shape())
                if shape != (self.frames, self.height, self.width):
                    raise ValueError(f"{self.path} holds {shape} frames, rows and columns, not what its description says; {fix}")
                yield file
        except SafetensorError as error:
            raise ValueError(f"{self.path} is not a complete clip ({error}); {fix}") from error


def write_shard(path: Path, tensors: dict[str, torch.Tensor], meta: dict) -> None:
    """Store one clip; the json file is written last, so a shard without one is unfinished and is made again."""
    from safetensors.torch import save

    stored = STORED | (REFERENCES if "trust" in tensors else {})
    for name, dtype in stored.items():
        check_tensor(name, tensors[name], ("T", "H", "W", {"flow": 2}.get(name, 3)) if tensors[name].ndim == 4 else ("T", "H", "W"), dtype)
    made_folder(path.parent)
    t, h, w = tensors["region"].shape
    with atomic_file(path) as half:
        half.write_bytes(save({name: tensors[name].contiguous() for name in stored}))
    with atomic_file(path.with_suffix(".json")) as half:
        Path(half).write_text(json.dumps({"frames": t, "height": h, "width": w, **meta}, indent=1))


def is_whole(path: Path) -> bool:
    """Whether `write_shard` has finished the clip that it stores there."""
    return path.with_suffix(".json").exists()


class PairSet:
    """All finished shards of a pairs folder, or of several; of a folder with one such folder a scene, all of these."""

    def __init__(self, *folders: str | Path):
        found: dict[Path, Path] = {}  # a folder may be named twice, or with one in it
        for folder in map(Path, folders):
            if not folder.is_dir():
                raise FileNotFoundError(
                    f"{folder} is not a folder of pairs; make one with: sidestep pairs SCENE --data DRIVE -o {quote(str(folder))}"
                )
            for file in sorted([*folder.glob("*/*.json"), *folder.glob("*/*/*.json")]):
                if file.parent.name in KINDS and file.name != NOTE and not file.name.startswith("."):
                    found.setdefault(file.resolve(), file)
        self.shards = [_read_meta(file) for file in found.values()]
        if not self.shards:
            raise ValueError(
                f"no pairs in {', '.join(map(str, folders))}; "
                f"make some with: sidestep pairs SCENE --data DRIVE -o {quote(str(folders[0])) if folders else 'pairs'}"
            )

    def digest(self) -> str:
        """Which clips these are: the same for the same names, sizes, seeds and times, which tell drives of one data set apart."""
        names = [(s.meta["kind"], s.path.stem, s.frames, s.height, s.width, s.meta.get("seed", 0)) for s in self.shards]
        told = sorted([*name, *s.meta.get("times_us", [])[:1]] for name, s in zip(names, self.shards, strict=True))
        return hashlib.sha256(json.dumps(told).encode()).hexdigest()[:16]

    def of(self, kind: str | None = None, split: str | None = None) -> list[Shard]:
        return [s for s in self.shards if (kind is None or s.meta["kind"] == kind) and (split is None or s.meta["split"] == split)]


def _read_meta(file: Path) -> Shard:
    try:
        meta = json.loads(file.read_text())
        shard = Shard(file.with_suffix(".safetensors"), int(meta["frames"]), int(meta["height"]), int(meta["width"]), meta)
        known = meta["kind"] in KINDS and meta["split"] in ("train", "held out")
    except (json.JSONDecodeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file} is not a pair's description ({error}); delete it and run sidestep pairs again") from error
    if not known:
        raise ValueError(
            f'{file} has kind "{meta["kind"]}" and split "{meta["split"]}"; known are {", ".join(KINDS)} and "train", "held out"'
        )
    if not shard.path.is_file():
        raise FileNotFoundError(
            f"{shard.path} is missing although {file.name} describes it; delete {file.name} and run sidestep pairs again"
        )
    return shard


def to_bytes(image: torch.Tensor | np.ndarray) -> torch.Tensor:
    """Floats in 0..1 to uint8 by rounding."""
    return (torch.as_tensor(image).clamp(0, 1) * 255).round().to(torch.uint8)
