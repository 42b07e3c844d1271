"""What pairs are made from: a scene as it was recorded, its recording, and which cameras and kinds these allow."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from enhance.pairs.shards import KINDS
from recon import open_log
from recon.log import Log
from scenes.files import kind_of
from scenes.names import unknown
from scenes.opening import scene_folder
from scenes.scene import Scene
from scenes.usd.scene import load_recorded


def open_reconstruction(path: str | Path | Scene) -> Scene:
    """A scene without its edits, of which its photos show none. ValueError where the path holds no scene."""
    if isinstance(path, Scene):
        return path
    if kind_of(path) != "scene":
        raise ValueError(f"{path} is not a scene; pairs are made from a scene that sidestep recon wrote")
    return load_recorded(scene_folder(path))


def open_recording(path: str | Path, scene: Scene) -> Log:
    """The recording that a scene was made from, in the scene's world; one of pictures alone gets the scene's scale. ValueError where its
    place differs from the scene's; where only the name differs, stderr says so."""
    told = scene.meta.get("world_from_model")
    start_us, duration_us = scene.meta.get("part_us", (0, None))
    log = open_log(path) if told is None else open_log(path, metres_per_unit=float(told["scale"]), part_us=(start_us, duration_us))
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
    """The names `cameras`; where None, of all cameras that scene and recording share. ValueError for one that they do not share, and where
    they share none."""
    both = [name for name in log.cameras if name in scene.rig]
    for name in cameras or ():
        if name not in both:
            raise ValueError(unknown("camera", name, "both the scene and its recording", both))
    if not both:
        raise ValueError("the scene and the recording have no camera in common; make the pairs from the drive that the scene came from")
    return list(cameras or both)


def held_out_camera(scene: Scene, log: Log) -> str | None:
    """The camera whose pairs are never trained on: the front camera that scene and recording share; None where they share only one
    camera."""
    both = check_cameras(scene, log, None)
    return next((name for name in log.front if name in both), both[0]) if len(both) > 1 else None


def check_kinds(kinds: Sequence[str]) -> tuple[str, ...]:
    """The kinds, with isp_frame added to isp: the same image pipeline on whole frames and on instances. ValueError for an unknown kind."""
    for kind in kinds:
        if kind not in KINDS:
            raise ValueError(unknown("kind", kind, "the pairs that can be made", KINDS))
    return tuple(kinds) + (("isp_frame",) if "isp" in kinds and "isp_frame" not in kinds else ())
