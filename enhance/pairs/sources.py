"""What damage is made from beside a scene and its photos: reconstructions from less, assets and skies, prepared once for all clips."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from torch.nn import functional as F

from enhance.pairs.claims import FITS
from enhance.pairs.clips import PairConfig, of_scene
from enhance.pairs.diffusion_renderer import Relit
from enhance.pairs.inputs import check_kinds
from enhance.pairs.refits import REFITS, SHORT, Less, Refit, as_reconstructed, exposed_as, refits, shots_of
from enhance.pairs.shards import KINDS
from recon import stopped_early
from recon.assets.extract import FEWEST_SPLATS, Candidate, candidates
from recon.early import SHORT as EARLY
from recon.log import Log
from recon.registration.corrected import as_corrected
from recon.views.egomask import with_ego_masks
from render.references import References, Shot
from scenes.asset import Asset
from scenes.databank import Databank
from scenes.files import load
from scenes.hdr import load_hdr
from scenes.scene import Scene
from scenes.sky import Sky


@dataclass(frozen=True)
class Sources:
    """What damage is made from beside the scene and its photos.

    early   the scene stopped early, for underfit (without any, splats are spoilt by rule instead)
    shots   the recording's photos, which underfit's and reinsert's views may be compared with
    refits  by kind the reconstructions from less (`enhance.pairs.refits`)
    skies   HDR skies, for relight and shadow, beside made-up ones
    relit   the recording's photos under other skies, by which relight lights objects anew (without, by their splats' normals)
    own     assets cut out of the scene with their photos, by track, for reinsert
    assets  those that may be put anywhere, for shadow
    kinds   for which this was prepared
    """

    early: Sequence[Refit] = ()
    shots: Sequence[Shot] = ()
    refits: Mapping[str, Sequence[Refit]] = field(default_factory=dict)
    skies: Sequence[Sky] = ()
    relit: Relit | None = None
    own: Mapping[str, Asset] = field(default_factory=dict)
    assets: Sequence[Asset] = ()
    kinds: Sequence[str] = ()


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
    """What `kinds` are made from, all that can be made where None (`kinds` of the result): reconstructions from less, assets and skies.

    folder: keeps the reconstructions, which take some minutes each, once. skies: .hdr files. databank: folder of further assets beside
    those that are cut out of the scene. device: where to fit. seed: each leaves out other frames and splats. relit: the folder that is
    shared with DiffusionRenderer.

    Raises ValueError for an unknown kind, where the rig has too few cameras for one, where shadow has no asset to put in, and for a broken
    sky or databank asset.
    """
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
    """All kinds that can be made of a scene and its recording: crossref needs two cameras; shadow an asset, of the databank or without
    flaws among those `found` in the scene; reinsert one of these that moved."""
    able = {
        "crossref": len([name for name in log.cameras if name in scene.rig]) > 1,
        "shadow": any(not c.flaw for c in found) or (databank is not None and bool(Databank(databank).entries())),
        "reinsert": any(_returns(c) for c in found),
    }
    return tuple(kind for kind in KINDS if able.get(kind, True))


def _returns(candidate: Candidate) -> bool:
    """Whether it can be put back where it moved."""
    return bool(candidate.asset.meta["moved"]) and len(candidate.asset.gaussians) >= FEWEST_SPLATS


def _sky(path: str | Path, width: int = 256) -> Sky:
    """A sky image, small enough to be looked up fast; areas are averaged, so that the sun keeps its light."""
    linear = load_hdr(path)
    return Sky(F.interpolate(linear.permute(2, 0, 1)[None], (width // 2, width), mode="area")[0].permute(1, 2, 0).contiguous())
