"""The kinds of damage that pairs are made of, a function each: from a clip to frames that are wrong, and what they should be."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn import functional as F

from enhance.pairs.clips import Clip
from enhance.pairs.compositing import NoPlace, put_back, put_in
from enhance.pairs.degrade import random_underfit, unfinish
from enhance.pairs.diffusion_renderer import Relit
from enhance.pairs.isp import Isp, alter, random_isp, random_pipeline
from enhance.pairs.lighting import Illumination, random_sky, relit, smoothed, under
from enhance.pairs.shards import to_bytes
from enhance.pairs.sources import Sources
from render.references import READS, References
from scenes.scene import Scene


@dataclass(frozen=True)
class Damage:
    """uint8 frames `[T, H, W, 3]` as they are and as they should be, the changed region `[T, H, W]` in 0..1, and what was done in words.

    scene  what the frames show, where that is not the clip's own
    told   ids uint8 `[T, H, W]` to tell in place of its instances
    reference, trust  where photos say more than the frames (`render.references`): what, uint8 like them, and how much that is to be
                      trusted `[T, H, W]` in 0..1
    """

    input: torch.Tensor
    target: torch.Tensor
    region: torch.Tensor
    what: dict
    scene: Scene | None = None
    told: torch.Tensor | None = None
    reference: torch.Tensor | None = None
    trust: torch.Tensor | None = None


def make(kind: str, clip: Clip, sources: Sources) -> Damage:
    """A clip with one kind of damage; the same clip's is always the same."""
    return MAKERS[kind](clip, np.random.default_rng([clip.seed, ORDER.index(kind)]), sources)


def _clean(clip: Clip, rng: np.random.Generator, sources: Sources) -> Damage:
    """The photos as they are: there is nothing to do."""
    return Damage(clip.photos.clone(), clip.photos, torch.zeros(clip.photos.shape[:3]), {})


def _underfit(clip: Clip, rng: np.random.Generator, sources: Sources) -> Damage:
    """A reconstruction stopped after 25 to 75 percent of its steps, or spoilt by rule."""
    what: dict[str, object]
    if sources.early and rng.random() < 0.7:
        pick = int(rng.integers(len(sources.early)))
        references = sources.early[pick].references
        what = {"underfit": "stopped early", "scene": str(references.recorded.meta.get("name", pick))}
    else:
        how = random_underfit(rng)
        references = References(sources.shots, unfinish(clip.scene, how, int(rng.integers(2**31))).to(clip.device))
        what = {"underfit": vars(how)}
    return _rendered(clip, references, what)


def _refitted(kind: str) -> Callable[[Clip, np.random.Generator, Sources], Damage]:
    def damage(clip: Clip, rng: np.random.Generator, sources: Sources) -> Damage:
        """What a reconstruction from less shows of the clip's views."""
        fair = [refit.references for refit in sources.refits.get(kind, ()) if clip.name in refit.cameras]
        if not fair:
            raise ValueError(f"{kind} pairs of {clip.name} need a reconstruction from less; pass sources.refits (enhance.pairs.refits)")
        references = fair[int(rng.integers(len(fair)))]
        return _rendered(clip, references, {"scene": str(references.recorded.meta.get("name", kind))})

    return damage


def _rendered(clip: Clip, references: References, what: dict) -> Damage:
    """What a scene shows, and what the pictures that it was made from say of it, but never the photo that is the target."""
    frames = list(references.along(clip.draw(references.recorded, *READS), clip.cameras))
    rgb, reference = (torch.stack([to_bytes(getattr(f, name)) for f in frames]).cpu() for name in ("rgb", "reference"))
    trust = torch.stack([f.trust for f in frames if f.trust is not None]).cpu()
    return Damage(rgb, clip.photos, torch.ones(clip.photos.shape[:3]), what, reference=reference, trust=trust)


def _isp(clip: Clip, rng: np.random.Generator, sources: Sources) -> Damage:
    """Instances in other colours, sharpened or noisy."""
    region, chosen = _some(clip, rng)
    isp = random_pipeline(rng)
    return Damage(_processed(clip, region, isp), clip.photos, region, {"instances": chosen, "isp": vars(isp)})


def _isp_frame(clip: Clip, rng: np.random.Generator, sources: Sources) -> Damage:
    """The whole picture in other colours, sharpened or noisy: only what right pictures look like can tell."""
    everywhere, isp = torch.ones(clip.photos.shape[:3]), random_pipeline(rng)
    damaged = _processed(clip, everywhere, isp)
    return Damage(damaged, clip.photos, everywhere, {"instances": [1], "isp": vars(isp)}, told=everywhere.to(torch.uint8))


def _processed(clip: Clip, region: torch.Tensor, isp: Isp) -> torch.Tensor:
    rgb = clip.photos.permute(0, 3, 1, 2).float() / 255
    return to_bytes(alter(rgb, region[:, None], isp).permute(0, 2, 3, 1))


def _relight(clip: Clip, rng: np.random.Generator, sources: Sources) -> Damage:
    """Instances in the light of another sky: by the normals of their splats, or as DiffusionRenderer shows them."""
    region, chosen = _some(clip, rng)
    if sources.relit is not None:
        return _relit(clip, rng, sources.relit, region, chosen)
    sky, gain = random_sky(rng, sources.skies), float(2 ** rng.uniform(-0.6, 0.6))
    damaged = clip.photos.clone()
    if chosen:
        before, after = Illumination.of(clip.scene), Illumination.of(under(clip.scene, sky))
        for t, frame in enumerate(clip.render(clip.scene, "normal")):
            assert frame.normal is not None
            normals = smoothed(frame.normal @ frame.camera.world_from_cam[:3, :3].T.float(), (region[t] > 0).float())
            damaged[t] = to_bytes(relit(clip.photo(t), normals, region[t], before, after, gain))
    return Damage(damaged, clip.photos, region, {"instances": chosen, "gain": gain})


def _relit(clip: Clip, rng: np.random.Generator, relit: Relit, region: torch.Tensor, chosen: list[int]) -> Damage:
    count, height, width = clip.photos.shape[:3]
    lights = relit.lights(clip.label, count)
    if not lights:
        raise ValueError(f"{relit.folder} has no photos of {clip.label} under another sky; run make_pairs, which says what is to be done")
    light = lights[int(rng.integers(len(lights)))]
    pictures = relit.read(light, clip.label, count, (width, height)).float() / 255
    seen = torch.stack([clip.at_once(picture, t) for t, picture in enumerate(pictures)])
    damaged = torch.lerp(clip.photos.float() / 255, seen, region[..., None])
    return Damage(to_bytes(damaged), clip.photos, region, {"instances": chosen, "light": light})


def _shadow(clip: Clip, rng: np.random.Generator, sources: Sources) -> Damage:
    """An asset that stands in the photo without its shadow; the target has it, of the scene's own sky or of another."""
    if not sources.assets:
        raise ValueError("shadow pairs need assets to put in; give a databank that has some (--databank), or sources.assets")
    sky = random_sky(rng, sources.skies) if rng.random() < 0.5 else None
    try:
        bare, shaded, region, scene, what = put_in(clip, under(clip.scene, sky), sources.assets, rng)
    except NoPlace:
        return _clean(clip, rng, sources)
    return Damage(to_bytes(bare), to_bytes(shaded), region, what | {"sky": "the scene's" if sky is None else "another"}, scene)


def _reinsert(clip: Clip, rng: np.random.Generator, sources: Sources) -> Damage:
    """Extracted assets back at their own places, in other colours and without shadow, where the photo has them."""
    known = [i for i in clip.large() if clip.scene.actors[i - 1].track in sources.own]
    chosen = [i for i in known if rng.random() < 0.6] or known[:1]
    if not chosen:
        return _clean(clip, rng, sources)
    actors = list(clip.scene.actors)
    for i in chosen:
        own = sources.own[actors[i - 1].track]
        actors[i - 1] = replace(actors[i - 1], asset=replace(own, meta={**own.meta, "edited": True}))
    isp = random_isp(rng, 0.6)
    back = put_back(clip, replace(clip.scene, actors=tuple(actors)), chosen, isp, sources.shots)
    what = {"instances": chosen, "tracks": [actors[i - 1].track for i in chosen], "isp": vars(isp)}
    return Damage(to_bytes(back.frames), clip.photos, back.region, what, reference=to_bytes(back.reference), trust=back.trust)


def _some(clip: Clip, rng: np.random.Generator) -> tuple[torch.Tensor, list[int]]:
    """The region `[T, H, W]` of some of the instances that are large enough, their edges soft by a pixel; and their ids."""
    ids = clip.large()
    chosen = [i for i in ids if rng.random() < 0.6] or ids[:1]
    mask = torch.isin(clip.geometry()["instance"], torch.tensor(chosen, dtype=torch.uint8)).float()
    return F.avg_pool2d(mask[:, None], 3, 1, 1)[:, 0], chosen


MAKERS: dict[str, Callable[[Clip, np.random.Generator, Sources], Damage]] = {
    "underfit": _underfit,
    "isp": _isp,
    "clean": _clean,
    "sparse": _refitted("sparse"),
    "cycle": _refitted("cycle"),
    "crossref": _refitted("crossref"),
    "relight": _relight,
    "shadow": _shadow,
    "reinsert": _reinsert,
    "isp_frame": _isp_frame,
}
ORDER = tuple(MAKERS)  # a kind's place is part of its seed: new kinds go to the end
