"""Pairs of damaged and right frames, made by our renderer from a reconstructed drive and its recording."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import torch
from torch.nn import functional as F

from enhance.pairs.claims import claim_pairs
from enhance.pairs.clips import Clip, PairConfig, clip_label, of_scene
from enhance.pairs.damage import Damage, make
from enhance.pairs.diffusion_renderer import Relit
from enhance.pairs.inputs import check_cameras, check_kinds, held_out_camera, open_reconstruction, open_recording
from enhance.pairs.shards import PairSet, is_whole, to_bytes, write_shard
from enhance.pairs.sources import Sources
from recon.log import Log, LogCamera
from recon.views.egomask import with_ego_masks
from scenes.scene import Scene
from scenes.spread import spread

ROWS, WIDTH = 8, 320
"""Clips on a contact sheet, and the pixels across each of its pictures."""

ANYWHERE = ("underfit", "isp", "isp_frame", "clean")
"""Kinds that need nothing but a scene and its recording."""


def make_pairs(
    scene_path: str | Path | Scene,
    log_path: str | Path | Log,
    out: str | Path,
    kinds: Sequence[str] = ANYWHERE,
    cameras: Sequence[str] | None = None,
    seed: int = 0,
    progress: Callable[[int, int, str], None] | None = None,
    sources: Sources | None = None,
    config: PairConfig | None = None,
    device: str = "cpu",
    made_of: dict[str, str] | None = None,
) -> Path:
    """Make the pairs of a scene in the folder `out`; returns it. Scene and recording may be given loaded.

    Every clip of every camera, with each of `kinds` (damage.py), and with flow, visibility, depth and instances of what it shows.
    `sources` is what the damage is made from (`prepare_sources`); without any, the kinds ANYWHERE can be made.
    Scenes are rendered on `device`. made_of: what `sources` are, by name (`claim_pairs`): with others the folder is refused.

    The same seed makes the same pairs. A run that was broken off goes on where it stopped, and kinds may be added later. `progress` is
    called with clips done, clips in all, and the last one's name. A contact sheet of each kind, `<kind>.png`, stands beside the clips.
    The front camera's are of the split "held out", which is never trained on, where the drive has other cameras.

    Raises ValueError for an unknown kind or camera, for a camera that the scene was not given, and for a folder made with other settings.
    """
    config, sources = config or PairConfig(), sources or Sources()
    scene = open_reconstruction(scene_path)
    log = of_scene(log_path if isinstance(log_path, Log) else open_recording(log_path, scene), scene)
    kinds = check_kinds(kinds)
    chosen, kept = check_cameras(scene, log, cameras), held_out_camera(scene, log)
    out = claim_pairs(out, scene, log, seed, config, made_of)
    rights = {k: log.meta[k] for k in ("licence", "attribution") if k in log.meta}
    log = with_ego_masks(log, chosen, config.width)
    starts = [(log.cameras[name], start) for name in chosen for start in _starts(len(log.cameras[name]), config)]
    if "relight" in kinds and sources.relit is not None:
        _ask(sources.relit, [s for s in starts if not _is_made(out, "relight", s[0], s[1])], config)
    untouched = dict.fromkeys(kinds, 0)
    for done, (camera, start) in enumerate(starts):
        name = clip_label(camera.name, start)
        missing = [kind for kind in kinds if not _is_made(out, kind, camera, start)]
        split = {"split": "held out" if camera.name == kept else "train"}
        clip = Clip(scene, camera, start, config, seed, split | rights, device) if missing else None
        for kind in missing:
            assert clip is not None
            damage = make(kind, clip, sources)
            untouched[kind] += kind != "clean" and not damage.region.any()
            _write(out / kind / f"{name}.safetensors", kind, clip, damage)
        if progress is not None:
            progress(done + 1, len(starts), name)
    for kind, count in untouched.items():
        if count:
            print(f"{kind}: {count} of {len(starts)} clips show nothing to change, and stay as their photos are", file=sys.stderr)
    for kind in kinds:
        contact_sheet(PairSet(out), kind, out / f"{kind}.png")
    return out


def _is_made(out: Path, kind: str, camera: LogCamera, start: int) -> bool:
    """Whether a clip is there."""
    return is_whole(out / kind / f"{clip_label(camera.name, start)}.safetensors")


def _ask(relit: Relit, starts: list[tuple[LogCamera, int]], config: PairConfig) -> None:
    """Write the photos of those clips that DiffusionRenderer has not lit yet, for it to read; where there are any, ValueError saying what
    to run."""
    clips = [(camera, start, range(start, min(start + config.frames, len(camera)))) for camera, start in starts]
    lacking = [clip for clip in clips if not relit.lights(clip_label(clip[0].name, clip[1]), len(clip[2]))]
    for camera, start, indices in lacking:
        relit.ask(camera, clip_label(camera.name, start), indices)
    if lacking:
        told = f"{relit.folder} lacks {len(lacking)} of {len(clips)} clips under other skies; their photos are in its photos/ now"
        raise ValueError(f"{told}. In a checkout of cosmos1-diffusion-renderer run\n{relit.commands()}\nthen this again")


def _write(path: Path, kind: str, clip: Clip, damage: Damage) -> None:
    tensors = {"input": damage.input, "target": damage.target, "region": to_bytes(damage.region), **clip.geometry(damage.scene)}
    if damage.told is not None:
        tensors["instance"] = damage.told
    if damage.reference is not None and damage.trust is not None:
        tensors |= {"reference": damage.reference, "trust": to_bytes(damage.trust)}
    write_shard(path, tensors, {"kind": kind, **clip.meta, **damage.what})


def _starts(frames: int, config: PairConfig) -> Iterator[int]:
    """The first frames of the clips that a recording of so many frames is cut into."""
    return iter(range(0, max(frames - config.frames, 0) + 1, config.every))


def contact_sheet(pairs: PairSet, kind: str, path: str | Path) -> None:
    """Write a picture of up to `ROWS` clips of a kind, spread over the set: input, target and changed region of each."""
    from render.contact import write_contact_sheet

    shards = pairs.of(kind)
    lines = []
    for shard in spread(shards, ROWS):
        w = shard.window(shard.frames // 2, 1)
        pictures = torch.stack([w.input[0], w.target[0], w.region[0].expand(3, -1, -1)])
        small = F.interpolate(pictures, (round(shard.height * WIDTH / shard.width), WIDTH), mode="area")
        lines.append((shard.path.stem, [picture.permute(1, 2, 0) for picture in small]))
    if lines:
        write_contact_sheet(Path(path), (f"{kind}: given", "wanted", "changed"), lines)
