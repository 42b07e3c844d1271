"""Pairs of damaged and right frames, made by our renderer from a reconstructed drive and its recording."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from enhance.degrade import random_underfit, unfinish
from enhance.isp import alter, random_isp
from enhance.shards import KINDS, PairSet, to_bytes, write_shard
from recon import open_log
from recon.log import Log, LogCamera
from render import render_frame
from render.warp import visible
from scenes.atomic import atomic_file
from scenes.files import load
from scenes.names import unknown
from scenes.scene import Scene

SMALLEST = 0.004  # an instance must cover this share of the frame to be altered
HELD_OUT = ("front_camera",)


@dataclass(frozen=True)
class PairConfig:
    """Sizes of the clips, and what is kept away from training."""

    width: int = 640
    """Width of the stored frames in pixels; the height follows from the camera."""
    frames: int = 6
    """Consecutive frames of a clip."""
    every: int = 6
    """Frames from one clip's start to the next's."""
    held_out: tuple[str, ...] = HELD_OUT
    """Cameras never trained on."""


def make_pairs(
    scene_path: str | Path | Scene,
    log_path: str | Path | Log,
    out: str | Path,
    kinds: Sequence[str] = KINDS,
    cameras: Sequence[str] | None = None,
    seed: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
    unfinished: Sequence[str | Path] = (),
    config: PairConfig | None = None,
) -> Path:
    """Make the pairs of a scene in the folder `out`; returns it. Scene and recording may be given loaded.

    Of every clip of every camera: "underfit", rendered from one of the scenes in `unfinished`, the same drive stopped early
    (`recon.stopped_early`), or from the scene with too few, too coarse splats, against the photo; "isp", the photo with the
    colours of its instances altered against the photo; "clean", the photo against itself. All with flow, visibility and instances
    rendered from the scene.

    The same seed makes the same pairs. A run that was broken off goes on where it stopped. `progress` is called with clips done,
    clips in all, and the last one's name. A contact sheet of each kind, `<kind>.png`, stands beside the clips.

    Raises ValueError for an unknown kind or camera, for a camera that the scene was not given, and for a folder made with other settings.
    """
    config = config or PairConfig()
    scene = scene_path if isinstance(scene_path, Scene) else load(scene_path)
    log = log_path if isinstance(log_path, Log) else open_log(log_path)
    if not isinstance(scene, Scene):
        raise ValueError(f"{scene_path} is not a scene; pairs are made from a scene that sidestep recon wrote")
    early = [s for s in map(load, unfinished) if isinstance(s, Scene)]
    for kind in kinds:
        if kind not in KINDS:
            raise ValueError(unknown("kind", kind, "the pairs that can be made", KINDS))
    both = [name for name in log.cameras if name in scene.rig]
    for name in cameras or ():
        if name not in both:
            raise ValueError(unknown("camera", name, "both the scene and its recording", both))
    chosen = list(cameras or both)
    if not chosen:
        raise ValueError("the scene and the recording have no camera in common; make the pairs from the drive that the scene came from")
    out = Path(out)
    _claim(out, {"seed": seed, "kinds": sorted(kinds), "width": config.width, "frames": config.frames, "every": config.every})
    starts = [(log.cameras[name], start) for name in chosen for start in _starts(len(log.cameras[name]), config)]
    for done, (camera, start) in enumerate(starts):
        name = f"{camera.name}_{start:04d}"
        if not all((out / kind / f"{name}.json").exists() for kind in kinds):
            clip = _Clip(scene, camera, start, config, seed, {k: log.meta[k] for k in ("licence", "attribution") if k in log.meta})
            for kind in kinds:
                tensors, what = clip.make(kind, early)
                write_shard(out / kind / f"{name}.safetensors", tensors, {"kind": kind, **clip.meta, **what})
        if progress is not None:
            progress(done + 1, len(starts), name)
    for kind in kinds:
        contact_sheet(PairSet(out), kind, out / f"{kind}.png")
    return out


def _claim(out: Path, settings: dict) -> None:
    """Note the settings in the folder, or refuse a folder made with others."""
    note = out / "pairs.json"
    if note.exists():
        if json.loads(note.read_text()) != settings:
            raise ValueError(f"{out} holds pairs made with other settings ({note.read_text()}); choose another folder")
        return
    out.mkdir(parents=True, exist_ok=True)
    with atomic_file(note) as half:
        Path(half).write_text(json.dumps(settings))


def _starts(frames: int, config: PairConfig) -> Iterator[int]:
    return iter(range(0, max(frames - config.frames, 0) + 1, config.every))


class _Clip:
    """One clip's photos and geometry, and the damage done to it."""

    def __init__(self, scene: Scene, camera: LogCamera, start: int, config: PairConfig, seed: int, rights: dict):
        self.scene, self.start = scene, start
        height = round(config.width * camera.height / camera.width)
        indices = range(start, min(start + config.frames, len(camera)))
        # The scene's own camera, not the recording's: reconstruction corrects poses, and only its poses match its splats.
        self.cameras = [scene.camera(camera.name, int(camera.times_us[i])).resized(config.width, height) for i in indices]
        self.target = torch.stack([torch.from_numpy(np.array(camera.image(i, config.width, height))) for i in indices])
        # Seeded by name: a clip is the same whichever others are made beside it.
        digest = hashlib.sha256(f"{seed} {camera.name} {start}".encode()).digest()
        self.seed = int.from_bytes(digest[:6], "little")
        split = "held out" if camera.name in config.held_out else "train"
        times = [c.time_us for c in self.cameras]
        self.meta = {"split": split, "camera": camera.name, "start": start, "times_us": times, "seed": seed} | rights
        self._geometry: dict[str, torch.Tensor] | None = None

    def geometry(self) -> dict[str, torch.Tensor]:
        """Instance, flow and visibility, as stored, from the finished scene; rendered once."""
        if self._geometry is None:
            instances, flows, seen, last = [], [], [], None
            for t, camera in enumerate(self.cameras):
                after = self.cameras[t + 1] if t + 1 < len(self.cameras) else None
                wanted = ["instance"] + ["flow_prev"] * (t > 0) + ["flow_next"] * (after is not None)
                frame = render_frame(self.scene, camera, tuple(wanted), self.cameras[t - 1] if t else None, after)
                assert frame.instance is not None
                none = torch.full((camera.height, camera.width, 2), torch.nan)
                flow = none if frame.flow_prev is None else frame.flow_prev
                flows.append(flow)
                instances.append(torch.where((frame.instance < 0) | (frame.instance > 254), 255, frame.instance).to(torch.uint8))
                both = last is not None and frame.flow_prev is not None
                seen.append(visible(_first(flow), _first(last))[0, 0] if both and last is not None else torch.zeros(none.shape[:2]).bool())
                last = frame.flow_next
            self._geometry = {
                "instance": torch.stack(instances),
                "flow": torch.stack(flows).to(torch.float16),
                "visible": torch.stack(seen).to(torch.uint8),
            }
        return self._geometry

    def make(self, kind: str, early: Sequence[Scene]) -> tuple[dict[str, torch.Tensor], dict]:
        """The clip's tensors for one kind of damage, and what was done in words."""
        rng = np.random.default_rng([self.seed, KINDS.index(kind)])
        what: dict[str, object]
        if kind == "underfit":
            damaged, what = self._underfit(rng, early)
            region = torch.ones(self.target.shape[:3])
        elif kind == "isp":
            region, what = self._objects(rng)
            isp = random_isp(rng)
            rgb = self.target.permute(0, 3, 1, 2).float() / 255
            damaged = to_bytes(alter(rgb, region[:, None], isp).permute(0, 2, 3, 1))
            what = what | {"isp": vars(isp)}
        else:
            damaged, region, what = self.target.clone(), torch.zeros(self.target.shape[:3]), {}
        return {"input": damaged, "target": self.target, "region": to_bytes(region), **self.geometry()}, what

    def _underfit(self, rng: np.random.Generator, early: Sequence[Scene]) -> tuple[torch.Tensor, dict]:
        what: dict[str, object]
        if early and rng.random() < 0.7:
            pick = int(rng.integers(len(early)))
            scene, what = early[pick], {"underfit": "stopped early", "scene": str(early[pick].meta.get("name", pick))}
        else:
            how = random_underfit(rng)
            scene, what = unfinish(self.scene, how, int(rng.integers(2**31))), {"underfit": vars(how)}
        frames = [render_frame(scene, camera, ("rgb",)).rgb for camera in self.cameras]
        return torch.stack([to_bytes(rgb) for rgb in frames if rgb is not None]), what

    def _objects(self, rng: np.random.Generator) -> tuple[torch.Tensor, dict]:
        """The region to alter `[T, H, W]`: some of the instances that are large enough, their edges soft by a pixel."""
        instance = self.geometry()["instance"]
        ids = [int(i) for i in instance.unique() if 0 < i < 255 and (instance == i).float().mean() > SMALLEST]
        chosen = [i for i in ids if rng.random() < 0.6] or ids[:1]
        mask = torch.isin(instance, torch.tensor(chosen, dtype=torch.uint8)).float()
        return F.avg_pool2d(mask[:, None], 3, 1, 1)[:, 0], {"instances": chosen}


def _first(flow: torch.Tensor) -> torch.Tensor:
    return flow.permute(2, 0, 1)[None]


def contact_sheet(pairs: PairSet, kind: str, path: str | Path, rows: int = 8, width: int = 320) -> None:
    """A picture of up to `rows` clips of a kind, spread over the set: damaged, right, region."""
    from render.video import write_image

    shards = pairs.of(kind)
    if not shards:
        return
    strips = []
    for shard in shards[:: max(1, len(shards) // rows)][:rows]:
        w = shard.window(shard.frames // 2, 1)
        strip = torch.cat([w.input[0], w.target[0], w.region[0].expand(3, -1, -1)], -1)
        strips.append(F.interpolate(strip[None], (round(shard.height * width / shard.width), 3 * width), mode="area")[0])
    write_image(path, torch.cat(strips, 1).permute(1, 2, 0))
