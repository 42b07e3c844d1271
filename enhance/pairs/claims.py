"""A pairs folder holds the pairs of one scene, made in one way: its note says of what and how, and other pairs are refused."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from enhance.pairs.clips import PairConfig
from enhance.pairs.shards import KINDS, NOTE
from recon.log import Log
from scenes.atomic import atomic_file, made_folder
from scenes.scene import Scene

FITS = ("early", "refits")
"""Folders of the reconstructions that pairs are made from, beside the pairs."""


def claim_pairs(out: str | Path, scene: Scene, log: Log, seed: int, config: PairConfig, made_of: dict[str, str] | None = None) -> Path:
    """The folder for a scene's pairs, with a note in it of how they are made; ValueError where it holds others, before anything is
    reconstructed. made_of: digests of what else they are made of, by its name in messages: skies, a databank."""
    settings = {"seed": seed, "width": config.width, "frames": config.frames, "every": config.every}
    claim(Path(out), settings, {"scene": _digest(scene), "recording": log.name, **(made_of or {})})
    return Path(out)


def claim(out: Path, settings: dict, made_of: dict) -> None:
    """Note in a folder how its pairs are made (`settings`) and of what (`made_of`, digests by name); ValueError where its note says
    otherwise.

    Older notes do not say of what. A note binds only where something was made: a run that was refused or stopped before leaves one, too.
    """
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
    """The entries of a folder's note by which something in it was made, as "skies of shadow" where it has clips of shadow; None where
    nothing was made."""
    kinds = {clip.parent.name for clip in out.glob("*/*.json")} & set(KINDS)
    if not kinds and not any(any(out.glob(f"{fits}/*")) for fits in FITS):
        return None
    return {name: of for name, of in noted.items() if (kind := name.rpartition(" of ")[2]) not in KINDS or kind in kinds}


def _digest(scene: Scene) -> str:
    """A hash of a scene's splats, actors and edits."""
    told = hashlib.sha256(json.dumps([scene.meta.get("name"), [e["name"] for e in scene.meta.get("edits", [])]]).encode())
    for splats in (scene.background.gaussians, *(a.asset.gaussians for a in scene.actors)):
        told.update(splats.means.cpu().numpy().tobytes())
    return told.hexdigest()[:16]
