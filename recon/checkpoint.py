"""A fit on disk: one file beside the scene that it will become, replaced whole, read without running anything foreign."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from recon.fit.config import FitConfig
from recon.fit.swept import Swept
from recon.log import Track
from recon.seeds.measured import Measured
from recon.start import Start
from scenes.camera import RigCamera
from scenes.ground import Ground
from scenes.lenses import LENSES
from scenes.state import load_state, save_state
from scenes.trajectory import Trajectory

VERSION = 19


def checkpoint_path(output: Path) -> Path:
    """Where the fit of a scene keeps its state: beside the scene's folder."""
    return output.with_name(f"{output.name}.fit")


def save_checkpoint(path: Path, options: dict, start: Start, fit: dict) -> None:
    """Write the fit's state; the former one stays until this one is whole."""
    data = {"version": VERSION, "options": options, "start": _plain_start(start), "fit": fit}
    save_state(path, data)


def load_checkpoint(path: Path, options: dict) -> tuple[Start, dict]:
    """Start (its splats are the fit's) and state. FileNotFoundError without one, ValueError where it is corrupt or of other options."""
    if not path.is_file():
        raise FileNotFoundError(f"nothing to resume: {path} does not exist; run without --resume")
    try:
        data = load_state(path)
        version, saved = data["version"], data["options"]
    except (LookupError, TypeError, ValueError) as problem:
        raise ValueError(f"{path} is not a fit that can go on ({problem}); delete it and run without --resume") from None
    if version != VERSION:
        raise ValueError(f"{path} is of version {version}, and this is {VERSION}; delete it and run without --resume")
    for name, value in options.items():
        if saved.get(name) != value:
            raise ValueError(f"{path} was made with {_other(name, saved.get(name), value)}; repeat its options, or delete it")
    return _start(data["start"], data["fit"]), data["fit"]


def _other(name: str, saved: Any, value: Any) -> str:
    """How an option of a checkpoint differs, in the words of the command line where it has any."""
    if name == "world_from_model" and saved and value:
        if saved["scale"] == value["scale"]:
            return "another model of its pictures"
        return f"{saved['scale']:g} metres per unit of its model, not {value['scale']:g}"
    if name == "config" and saved and saved | {key: value[key] for key in ("steps", "budget")} == value:
        return "an --effort of {steps:,} steps and {budget:,} splats".format(**saved) + ", not {steps:,} and {budget:,}".format(**value)
    if name != "span_us" or saved is None:
        return f"{name} {saved!r}, not {value!r}"
    lasted, lasts = ((end - start) / 1e6 for start, end in (saved, value))
    if lasted != lasts:
        return f"a --duration of {lasted:g}s, not {lasts:g}s"
    later = (saved[0] - value[0]) / 1e6
    return f"a --start {abs(later):g}s {'later' if later > 0 else 'earlier'}"


def plain_config(config: FitConfig) -> dict:
    """The configuration as lists and numbers, to be compared after a round trip."""
    return {k: [list(x) if isinstance(x, tuple) else x for x in v] if isinstance(v, tuple) else v for k, v in asdict(config).items()}


def _plain_start(start: Start) -> dict:
    return {
        "tracks": plain_tracks(start.tracks),
        "ego": [start.ego.times_us, start.ego.world_from_body],
        "ground": [start.ground.heights, list(start.ground.origin), start.ground.cell],
        "ground_shown": start.ground_shown,
        "rig": {n: _plain_camera(r) for n, r in start.rig.items()},
        "measured": [[m.views, m.weight] for m in start.measured],
        "swept": start.swept.keys,
        "gains": list(start.gains),
        "skies": list(start.skies),
    }  # fmt: skip


def plain_tracks(tracks: Sequence[Track]) -> list[dict]:
    """Tracks as a checkpoint holds them; `tracks_of` makes them again."""
    return [
        {
            "name": t.name, "label": t.label, "moving": t.moving,
            "size": torch.from_numpy(t.size), "times_us": torch.from_numpy(t.times_us),
            "world_from_box": t.world_from_box, "sensor": torch.from_numpy(np.asarray(t.sensor)), "sources": list(t.sources),
            "off": t.off,
        }
        for t in tracks
    ]  # fmt: skip


def tracks_of(plain: Sequence[dict]) -> list[Track]:
    """The tracks that `plain_tracks` were made of."""
    return [
        Track(
            t["name"], t["label"], t["moving"], t["size"].numpy(), t["times_us"].numpy(),
            t["world_from_box"], t["sensor"].numpy(), tuple(t["sources"]), t["off"],
        )
        for t in plain
    ]  # fmt: skip


def _plain_camera(r: RigCamera) -> list:
    return [r.lens.kind, r.lens.params(), r.width, r.height, r.body_from_cam, r.times_us, r.shutter, r.readout_us]


def _camera(plain: list) -> RigCamera:
    kind, params, width, height, body_from_cam, times_us, shutter, readout_us = plain
    lens = LENSES[kind](*params.tolist())
    return RigCamera(lens, width, height, body_from_cam, times_us=times_us, shutter=shutter, readout_us=readout_us)


def _start(plain: dict, fit: dict) -> Start:
    from recon.fit.model import Splats

    rig = {n: _camera(r) for n, r in plain["rig"].items()}
    heights, origin, cell = plain["ground"]
    splats = Splats(fit["fields"], fit["sizes"], fit["reach"])
    ego, ground = Trajectory(*plain["ego"]), Ground(heights, tuple(origin), cell)
    measured, swept = tuple(Measured(*m) for m in plain["measured"]), Swept(plain["swept"])
    gains, skies = tuple(plain["gains"]), tuple(plain["skies"])
    told = (fit["sky"], fit["exposures"], ego, ground, plain["ground_shown"], rig, measured, swept, gains, skies)
    return Start(splats, tracks_of(plain["tracks"]), *told)
