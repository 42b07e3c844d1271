"""Assets cut from a reconstructed scene: what moved, and the parked vehicles whose boxes the log knows."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from recon.assets.cleaning import cleaned
from recon.assets.closing import closed
from recon.assets.looking import corners_of, looking_at
from recon.assets.photos import photos_of
from recon.assets.sight import FARTHEST, Sight, Views, sight_of
from recon.objects.mirror import mirrored, within_box
from render import Frame, rasterize
from render.album import shots_in
from render.references import Shot
from scenes.asset import Actor, Asset, AssetPhoto
from scenes.databank import Databank
from scenes.files import kind_of
from scenes.gaussians import Gaussians
from scenes.harmonics import rgb_from_sh, turned
from scenes.lenses import Pinhole
from scenes.match import ground_linear
from scenes.opening import scene_folder
from scenes.poses import inverse, matrix_from_quat, quat_from_matrix
from scenes.scene import Scene, dimmed
from scenes.seen import SECTORS, unseen_sides
from scenes.sky import linear_from_srgb
from scenes.trajectory import Trajectory
from scenes.usd.scene import load_recorded

FEWEST_SPLATS = 1000
FEWEST_VIEWS = 10
FULL_SIDE = 0.85
"""Part of a whole side that must be there: of a car that only its tail was seen of, half is missing."""

THUMB, FILLED = (320, 240), 0.9
"""Pixels of a picture of an asset, and the part of their width or height that its box takes up."""

CORNERS = {3: 145, 1: 35, 5: 215, 7: 325}
"""Degrees to the left of its nose from which a corner of `SECTORS` is pictured."""


@dataclass(frozen=True)
class Candidate:
    """A cut object before it is judged: its asset as its scene holds it, its track, and why it is not good enough, or ''.

    box     where its frame was on the drive
    instance  what its scene shows it as, 0 of what is parked; None where it bends on its way, so that no posture is its photos'
    gain `[3]`: of a mover, how much more the cameras were exposed half way than in the mean; None where that does not vary.
    """

    asset: Asset
    track: str
    flaw: str
    box: Trajectory
    instance: int | None
    gain: torch.Tensor | None = None

    def evenly_lit(self) -> Asset:
        """The asset as bright as what stands: a scene's own movers are as bright as exposures say that their light is."""
        return replace(self.asset, gaussians=dimmed(self.asset.gaussians, self.gain))

    def photos(self, scene: Scene, shots: Sequence[Shot]) -> tuple[AssetPhoto, ...]:
        """Its photos among those that its scene was made from."""
        return () if self.instance is None else photos_of(self.asset, scene, shots, self.box, self.instance)


def extract_assets(scene: Scene | str | Path, databank: str | Path) -> list[str]:
    """Cut movers and parked vehicles out of a scene, store those that are good enough, and return their ids, best first: those of which
    the fewest sides are unseen, and of these those of the most splats. What was cut out of this scene before keeps its id. A scene folder's
    are cut out as recorded, whatever was edited since; where it keeps its photos, each asset keeps those that show it, and one that is half
    hidden in all of them is not good enough.

    What is left out, or kept, is said on stderr with its reason. Raises ValueError where `scene` is no scene, or nothing in it is usable.
    """
    bank = Databank(databank)
    bank.ready()  # before the scene is looked through, which takes long
    shots: list[Shot] = []
    if not isinstance(scene, Scene):
        scene = scene_folder(scene)
        if kind_of(scene) != "scene":
            raise ValueError(f"{scene} is not a scene; assets are cut from a folder that sidestep recon wrote")
        recorded = load_recorded(scene)
        shots, scene = shots_in(scene, recorded), recorded
    found = sorted(candidates(scene), key=lambda c: (len(unseen_sides(c.asset)), -len(c.asset.gaussians)))
    ids: list[str] = []
    far = [c.track for c in found if not c.asset.meta["views"]]
    if far:
        said = f"{far[0]}: no camera saw it" if len(far) == 1 else f"{len(far)} ({', '.join(sorted(far))}): no camera saw them"
        print(f"left out {said} from within {FARTHEST:.0f} m", file=sys.stderr)
    for candidate in (c for c in found if c.asset.meta["views"]):
        photos = () if candidate.flaw else candidate.photos(scene, shots)
        hidden = "no photo shows most of it" if shots and candidate.instance is not None and not photos else ""
        if flaw := candidate.flaw or hidden:
            print(f"left out {candidate.track} ({candidate.asset.label}): {flaw}", file=sys.stderr)
        else:
            asset = closed(replace(candidate.evenly_lit(), photos=photos))
            if known := bank.same(asset):
                print(f"kept {known} as it is: {candidate.track} was cut out of this scene before", file=sys.stderr)
            ids.append(known or bank.add(asset, thumbnail(asset)))
    if not ids:
        raise ValueError(f"no object of {scene.meta.get('name', 'the scene')} is good enough for an asset; {len(found)} were looked at")
    return ids


def candidates(scene: Scene) -> Iterator[Candidate]:
    """Every mover and every parked vehicle of a scene as an asset in its own frame."""
    share = {k: scene.meta[k] for k in ("licence", "attribution") if k in scene.meta}
    share["source"] = scene.meta.get("source", scene.meta.get("name", ""))
    views = Views(scene)
    for instance, actor in enumerate(scene.actors, 1):
        if not actor.recorded:
            continue  # it came from a databank
        sight = sight_of(views, actor.trajectory, actor.asset.size)
        shown = _shown_best(actor.trajectory, scene.ego)
        gain = scene.followed(shown)
        cut = cleaned(within_box(at_rest(actor), actor.asset.size), actor.asset.size)
        meta = share | {"track": actor.track, "moved": True} | _ground(scene, actor.trajectory.at(shown))
        yield _judged(cut, actor.asset, meta, sight, actor.trajectory, None if actor.deformation else instance, gain)
    for entry in scene.meta.get("parked", []):
        world_from_box = torch.tensor(entry["world_from_box"], dtype=torch.float64)
        size = torch.tensor(entry["size"], dtype=torch.float64)
        if size.max() <= 0:
            continue
        near = moved(scene.background.gaussians, inverse(world_from_box) @ scene.background.world_from_local, size)
        cut = cleaned(within_box(near, size), size)
        stands = Trajectory(torch.zeros(1, dtype=torch.int64), world_from_box[None])
        sight = sight_of(views, stands, size)
        asset = Asset(cut, size, entry["label"], scene.model)
        yield _judged(cut, asset, share | {"track": entry["track"], "moved": False} | _ground(scene, world_from_box), sight, stands, 0)


def _shown_best(path: Trajectory, ego: Trajectory) -> int:
    """The time of a mover's poses at which it was nearest to the recording car: its colours are those of the light of there, and far ahead
    the ground is hardly known."""
    times = path.times_us[ego.covers_each(path.times_us)]
    if not len(times):
        return int(path.times_us[len(path) // 2])
    away = (path.at_each(times)[:, :2, 3] - ego.at_each(times)[:, :2, 3]).norm(dim=1)
    return int(times[away.argmin()])


def at_rest(actor: Actor) -> Gaussians:
    """An actor's splats in the one posture of those that were seen that moves them least: the mean of a walk is no posture."""
    splats, deformation = actor.asset.gaussians, actor.deformation
    if deformation is None or not len(splats):
        return splats
    postures = [deformation.at(int(t)).at(splats.means) for t in deformation.times_us]
    return replace(splats, means=splats.means + min(postures, key=lambda moved: float(moved.square().sum())))


def _ground(scene: Scene, pose: torch.Tensor) -> dict:
    """The light where an object stood, as `ground_linear` for its meta; {} where the ground there is unknown."""
    colour = ground_linear(scene, pose[:2, 3])
    return {} if colour is None else {"ground_linear": [round(v, 5) for v in colour.tolist()]}


def shown_colours(splats: Gaussians) -> dict[str, list[float]]:
    """Exposure statistics of splats: linear colour, the mean and the 5th and 95th percentile a channel, of what is not faint."""
    solid = splats.select(torch.sigmoid(splats.logit_opacities) > 0.3)
    if not len(solid):
        return {}
    linear = linear_from_srgb(rgb_from_sh(solid.sh[:, 0]).clamp(0, 1))
    low, high = linear.quantile(torch.tensor([0.05, 0.95]), 0)
    rows = {"linear_mean": linear.mean(0), "linear_p5": low, "linear_p95": high}
    return {name: [round(v, 4) for v in row.tolist()] for name, row in rows.items()}


def _judged(
    cut: Gaussians, asset: Asset, meta: dict, sight: Sight, box: Trajectory, instance: int | None, gain: torch.Tensor | None = None
) -> Candidate:
    flaw = ""
    if sight.views < FEWEST_VIEWS:
        flaw = f"{sight.views} views within {FARTHEST:.0f} m that show a side of it, fewer than {FEWEST_VIEWS}"
    elif (part := silhouette(cut, asset.size)) < FULL_SIDE:
        flaw = f"only {math.floor(100 * part)}% of its side was reconstructed, less than {FULL_SIDE:.0%}"
    whole, doubled = completed(cut, sight.left, sight.right) if not flaw else (cut, False)
    if not flaw and len(whole) < FEWEST_SPLATS:
        flaw = f"{len(whole)} splats, fewer than {FEWEST_SPLATS}"
    near = round(sight.nearest, 2) if math.isfinite(sight.nearest) else None
    meta = meta | {"views": sight.views, "sectors": sight.sectors, "mirrored": doubled, "nearest_m": near}
    meta["exposure"] = shown_colours(dimmed(whole, gain))
    return Candidate(replace(asset, gaussians=whole, meta=meta), meta["track"], flaw, box, instance, gain)


def silhouette(gaussians: Gaussians, size: torch.Tensor) -> float:
    """Part of the box's side, length by height, that splats stand in or within a cell of; 0.95 for a whole car."""
    length, _, height = size.tolist()
    cell = max(height / 8, 0.1)
    shape = math.ceil(length / cell), math.ceil(height / cell)
    solid = gaussians.means[torch.sigmoid(gaussians.logit_opacities) > 0.3]
    column = ((solid[:, 0] + length / 2) / cell).long().clamp(0, shape[0] - 1)
    row = (solid[:, 2] / cell).long().clamp(0, shape[1] - 1)
    grid = torch.zeros(1, 1, *shape)
    grid[0, 0, column, row] = 1
    return float(torch.nn.functional.max_pool2d(grid, 3, 1, 1).mean())


def moved(gaussians: Gaussians, to_from_local: torch.Tensor, size: torch.Tensor) -> Gaussians:
    """Splats near a box `[length, width, height]` at the origin of another frame, in that frame; harmonics turn along."""
    rotation, shift = to_from_local[:3, :3], to_from_local[:3, 3]
    means = gaussians.means.double() @ rotation.T + shift
    near = means.norm(dim=1) < float(size.norm())
    gaussians, means = gaussians.select(near), means[near]
    quats = quat_from_matrix(rotation @ matrix_from_quat(gaussians.quats.double()))
    return replace(gaussians, means=means.float(), quats=quats.float(), sh=turned(gaussians.sh, rotation))


def completed(gaussians: Gaussians, left: float, right: float) -> tuple[Gaussians, bool]:
    """An object whose sides were seen as unlike as `left` and `right` gets the better half's mirror image for the other half.

    Returns whether that was done, too: where one side was seen less than a third as well as the other.

    Cameras pass a parked car on one side only; cars, trucks and people are near enough symmetric about their xz plane.
    """
    y = gaussians.means[:, 1]
    if min(left, right) >= max(left, right) / 3:
        return gaussians, False
    half = gaussians.select(y >= 0 if left > right else y <= 0)
    return Gaussians.cat([half, mirrored(half)]), True


def thumbnail(asset: Asset) -> bytes:
    """A PNG of the asset on neutral grey, in three-quarter view from that corner of which, and of whose sides, the most photos were taken;
    from behind on its left where none were."""
    from PIL import Image

    counts = [asset.meta.get("sectors", {}).get(name, 0) for name in SECTORS]
    corner = max(CORNERS, key=lambda i: counts[i - 1] + 3 * counts[i] + counts[(i + 1) % len(SECTORS)])
    length, width, height = asset.size.tolist()
    centre = torch.tensor([0.0, 0.0, height / 2], dtype=torch.float64)
    distance = 1.7 * math.hypot(length, width, height)
    azimuth, elevation = math.radians(CORNERS[corner]), math.radians(18)
    direction = [math.cos(elevation) * math.cos(azimuth), math.cos(elevation) * math.sin(azimuth), math.sin(elevation)]
    camera = looking_at(centre, centre + distance * torch.tensor(direction, dtype=torch.float64), *THUMB)
    box = camera.lens.project((corners_of(asset.size) - camera.world_from_cam[:3, 3]) @ camera.world_from_cam[:3, :3])
    off = float((2 * box / torch.tensor(THUMB) - 1).abs().max())  # of what is tall as of what is long nothing is cut off
    focal = camera.lens.focal()[0] * FILLED / off
    camera = replace(camera, lens=Pinhole(focal, focal, camera.width / 2, camera.height / 2))
    with torch.no_grad():
        frame = rasterize(asset.gaussians, camera, ("rgb",), background=torch.tensor([0.72, 0.73, 0.75]), model=asset.model)
    assert isinstance(frame, Frame) and frame.rgb is not None
    pixels = np.round(frame.rgb.clamp(0, 1).numpy() * 255).astype(np.uint8)
    out = io.BytesIO()
    Image.fromarray(pixels).save(out, "png")
    return out.getvalue()
