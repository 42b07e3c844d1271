"""Pairs of damaged and right frames, made by our renderer from a reconstructed drive and its recording."""

from __future__ import annotations

import hashlib
import json
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch.nn import functional as F

from enhance.pairs.clips import Clip, PairConfig, clip_label, of_scene
from enhance.pairs.damage import Damage, Sources, make
from enhance.pairs.diffusion_renderer import Relit
from enhance.pairs.refits import REFITS, SHORT, Less, Refit, as_reconstructed, exposed_as, refits, shots_of
from enhance.pairs.shards import KINDS, NOTE, PairSet, is_whole, to_bytes, write_shard
from recon import open_log, stopped_early
from recon.assets.extract import FEWEST_SPLATS, Candidate, candidates
from recon.corrected import as_corrected
from recon.early import SHORT as EARLY
from recon.egomask import with_ego_masks
from recon.log import Log, LogCamera
from render.references import References
from scenes.atomic import atomic_file, made_folder
from scenes.databank import Databank
from scenes.files import kind_of, load
from scenes.hdr import load_hdr
from scenes.names import unknown
from scenes.opening import scene_folder
from scenes.scene import Scene
from scenes.sky import Sky
from scenes.spread import spread
from scenes.usd.scene import load_recorded

ROWS, WIDTH = 8, 320
"""Clips on a contact sheet, and the pixels across each of its pictures."""

FITS = ("early", "refits")
"""Folders of the reconstructions that pairs are made from, beside the pairs."""
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
) -> Path:
    """Make the pairs of a scene in the folder `out`; returns it. Scene and recording may be given loaded.

    Every clip of every camera, with each of `kinds` (damage.py), and with flow, visibility, depth and instances of what it shows.
    `sources` is what the damage is made from (`prepare_sources`); without any, the kinds ANYWHERE can be made.
    Scenes are rendered on `device`.

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
    out = claim_pairs(out, scene, log, seed, config)
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
    """Put there the photos of clips that were not lit anew yet; ValueError that says what to run, where there are any."""
    clips = [(camera, start, range(start, min(start + config.frames, len(camera)))) for camera, start in starts]
    lacking = [clip for clip in clips if not relit.lights(clip_label(clip[0].name, clip[1]), len(clip[2]))]
    for camera, start, indices in lacking:
        relit.ask(camera, clip_label(camera.name, start), indices)
    if lacking:
        told = f"{relit.folder} lacks {len(lacking)} of {len(clips)} clips under other skies; their photos are in its photos/ now"
        raise ValueError(f"{told}. In a checkout of cosmos1-diffusion-renderer run\n{relit.commands()}\nthen this again")


def prepare_sources(
    scene: Scene,
    log: Log,
    folder: str | Path,
    kinds: Sequence[str] | None = None,
    skies: Sequence[str | Path] = (),
    databank: str | Path | None = None,
    device: str = "cpu",
    seed: int = 0,
    relit: str | Path | None = None,
) -> Sources:
    """What `kinds` are made from, all that can be made where None (`kinds` of the result): reconstructions, kept in `folder` (made on
    `device`, some minutes each, once; each seed leaves out other things), assets cut out of the scene and those of a databank, and .hdr
    skies; `relit` is the folder in which DiffusionRenderer is met. Raises ValueError for an unknown kind, where the rig has too few cameras
    for one, where shadow has no asset to put in, and for a databank's asset or a sky that is broken."""
    check_kinds(kinds or ())
    folder = Path(folder)
    bank = Databank(databank) if databank is not None else None  # now, and skies: what is broken must not cost the wait for the fits
    stored = [bank.load(entry.id) for entry in bank.entries()] if bank is not None else []
    above = [_sky(path) for path in skies]
    names = [name for name in log.cameras if name in scene.rig]
    log = with_ego_masks(of_scene(log, scene), names, PairConfig.width)
    found = list(candidates(scene)) if kinds is None or {"shadow", "reinsert"} & set(kinds) else []
    kinds = kinds_for(scene, log, found, databank) if kinds is None else kinds
    anywhere = [c.evenly_lit() for c in found if not c.flaw] + stored
    if "shadow" in kinds and not anywhere:
        raise ValueError(
            "shadow pairs need assets to put in, and the scene has none to cut out; give --databank, or --kinds without shadow"
        )
    less = Less.drawn(seed)
    half_done = replace(EARLY, seed=seed, budget=round(EARLY.budget * less.fit.budget / SHORT.budget))
    there, half_done = as_corrected(log, scene.meta), exposed_as(scene, half_done)
    early = stopped_early(there, folder / FITS[0], names, config=half_done, device=device) if "underfit" in kinds else []
    shots = shots_of(as_reconstructed(log, scene), scene) if {"underfit", "reinsert"} & set(kinds) else []
    unfinished = [Refit(References(shots, s.to(device)), tuple(names)) for s in map(load, early) if isinstance(s, Scene)]
    made = {kind: refits(kind, scene, log, folder / FITS[1], less, device=device) for kind in REFITS if kind in kinds}
    moved = [c for c in found if _returns(c)] if "reinsert" in kinds else []
    own = {c.track: replace(c.asset, photos=c.photos(scene, shots)) for c in moved}
    lit = None if relit is None else Relit(Path(relit))
    return Sources(unfinished, shots, made, above, lit, own, anywhere, tuple(kinds))


def kinds_for(scene: Scene, log: Log, found: Sequence[Candidate], databank: str | Path | None = None) -> tuple[str, ...]:
    """All kinds that can be made of a scene, what was found in it to cut out, its recording and a databank: crossref takes two cameras,
    shadow an asset to put in, reinsert something that moved."""
    able = {
        "crossref": len([name for name in log.cameras if name in scene.rig]) > 1,
        "shadow": any(not c.flaw for c in found) or (databank is not None and bool(Databank(databank).entries())),
        "reinsert": any(_returns(c) for c in found),
    }
    return tuple(kind for kind in KINDS if able.get(kind, True))


def _returns(candidate: Candidate) -> bool:
    """Whether it can be put back where it moved."""
    return bool(candidate.asset.meta["moved"]) and len(candidate.asset.gaussians) >= FEWEST_SPLATS


def open_reconstruction(path: str | Path | Scene) -> Scene:
    """A scene as it was recorded, whatever was edited since: the photos show none of that. ValueError where the path holds something
    else."""
    if isinstance(path, Scene):
        return path
    if kind_of(path) != "scene":
        raise ValueError(f"{path} is not a scene; pairs are made from a scene that sidestep recon wrote")
    return load_recorded(scene_folder(path))


def open_recording(path: str | Path, scene: Scene) -> Log:
    """The recording that a scene was made from, in the scene's world: of pictures alone with its metres, not those guessed anew. ValueError
    where it is another one; stderr says where only its name is."""
    told = scene.meta.get("world_from_model")
    log = open_log(path) if told is None else open_log(path, metres_per_unit=float(told["scale"]))
    fix = "give each scene's own recording with --data"
    for key, part, much in (("world_origin", 0.0, 1.0), ("world_from_model", 1e-3, 1e-3)):
        ours, theirs = (_numbers(meta.get(key)) for meta in (scene.meta, log.meta))
        if len(ours) == len(theirs) and not np.allclose(theirs, ours, rtol=part, atol=much):
            raise ValueError(f"{path} is not the recording that the scene {scene.meta.get('name')} was made from: it is elsewhere; {fix}")
    if log.name != scene.meta.get("name"):
        print(f"{path} is called {log.name}, and its scene {scene.meta.get('name')}: if it is another drive, {fix}", file=sys.stderr)
    return log


def _numbers(told: object) -> np.ndarray:
    """All numbers in json-like data, in its order."""
    if isinstance(told, dict | list):
        return np.concatenate([np.zeros(0), *map(_numbers, told.values() if isinstance(told, dict) else told)])
    return np.array([told], dtype=float) if isinstance(told, int | float) and not isinstance(told, bool) else np.zeros(0)


def check_cameras(scene: Scene, log: Log, cameras: Sequence[str] | None) -> list[str]:
    """The cameras, all that scene and recording share where None. ValueError for one that they do not, and where they share none."""
    both = [name for name in log.cameras if name in scene.rig]
    for name in cameras or ():
        if name not in both:
            raise ValueError(unknown("camera", name, "both the scene and its recording", both))
    if not both:
        raise ValueError("the scene and the recording have no camera in common; make the pairs from the drive that the scene came from")
    return list(cameras or both)


def held_out_camera(scene: Scene, log: Log) -> str | None:
    """The camera whose pairs are never trained on: the front one of those that scene and recording share; None where they share but one."""
    both = check_cameras(scene, log, None)
    return next((name for name in log.front if name in both), both[0]) if len(both) > 1 else None


def check_kinds(kinds: Sequence[str]) -> tuple[str, ...]:
    """The kinds, with isp_frame beside isp: an image pipeline's doings on instances and on whole frames. ValueError for a kind that there
    is not."""
    for kind in kinds:
        if kind not in KINDS:
            raise ValueError(unknown("kind", kind, "the pairs that can be made", KINDS))
    return tuple(kinds) + (("isp_frame",) if "isp" in kinds and "isp_frame" not in kinds else ())


def _sky(path: str | Path, width: int = 256) -> Sky:
    """A sky image, small enough to be looked up fast; areas are averaged, so that the sun keeps its light."""
    linear = load_hdr(path)
    return Sky(F.interpolate(linear.permute(2, 0, 1)[None], (width // 2, width), mode="area")[0].permute(1, 2, 0).contiguous())


def _write(path: Path, kind: str, clip: Clip, damage: Damage) -> None:
    tensors = {"input": damage.input, "target": damage.target, "region": to_bytes(damage.region), **clip.geometry(damage.scene)}
    if damage.told is not None:
        tensors["instance"] = damage.told
    if damage.reference is not None and damage.trust is not None:
        tensors |= {"reference": damage.reference, "trust": to_bytes(damage.trust)}
    write_shard(path, tensors, {"kind": kind, **clip.meta, **damage.what})


def claim_pairs(out: str | Path, scene: Scene, log: Log, seed: int, config: PairConfig, made_of: dict[str, str] | None = None) -> Path:
    """The folder for a scene's pairs, which is noted in it; ValueError where it holds others, before anything is reconstructed for them.
    made_of: what else they are made of, by what it is called: skies, a databank."""
    settings = {"seed": seed, "width": config.width, "frames": config.frames, "every": config.every}
    claim(Path(out), settings, {"scene": _digest(scene), "recording": log.name, **(made_of or {})})
    return Path(out)


def claim(out: Path, settings: dict, made_of: dict) -> None:
    """Note in a folder how its pairs are made, and of what; or refuse a folder made otherwise. Of what, folders of before do not say.
    What a run noted that made nothing, as it was refused or stopped before, binds none."""
    note, before = made_folder(out) / NOTE, None
    if note.exists():
        try:
            noted = dict(json.loads(note.read_text()))
        except (TypeError, ValueError) as error:
            raise ValueError(f"{note} does not say how these pairs were made ({error}); choose another folder") from error
        before = _binding(out, noted)
    if before is not None:
        if {k: v for k, v in before.items() if k in settings} != settings:
            raise ValueError(f"{out} holds pairs made with other settings ({note.read_text()}); choose another folder")
        for name, digest in made_of.items():
            if before.get(name, digest) != digest:
                raise ValueError(f"{out} holds pairs of another {name}, or of this one before it was changed; choose another folder")
        if made_of.keys() <= before.keys():
            return
    with atomic_file(note) as half:
        Path(half).write_text(json.dumps((before or {}) | settings | made_of))


def _binding(out: Path, noted: dict) -> dict | None:
    """Of what a folder's note says, what something that is there was made by, as "skies of shadow" where there are clips of shadow; None
    where nothing is there."""
    kinds = {clip.parent.name for clip in out.glob("*/*.json")} & set(KINDS)
    if not kinds and not any(any(out.glob(f"{fits}/*")) for fits in FITS):
        return None
    return {name: of for name, of in noted.items() if (kind := name.rpartition(" of ")[2]) not in KINDS or kind in kinds}


def _digest(scene: Scene) -> str:
    """Of what a scene shows: its splats, actors and edits."""
    told = hashlib.sha256(json.dumps([scene.meta.get("name"), [e["name"] for e in scene.meta.get("edits", [])]]).encode())
    for splats in (scene.background.gaussians, *(a.asset.gaussians for a in scene.actors)):
        told.update(splats.means.cpu().numpy().tobytes())
    return told.hexdigest()[:16]


def _starts(frames: int, config: PairConfig) -> Iterator[int]:
    return iter(range(0, max(frames - config.frames, 0) + 1, config.every))


def contact_sheet(pairs: PairSet, kind: str, path: str | Path) -> None:
    """A picture of up to `ROWS` clips of a kind, spread over the set: damaged, right, region."""
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
