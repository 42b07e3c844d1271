"""An asset takes on the light of the place where it is put: exposure and white balance, in linear light, by the ground beneath.

The ground is the one thing that stands in the same light as an asset and is of much the same grey everywhere. An asset remembers the
colour of the ground where it was cut out (`ground_linear` in its meta; for a mesh, that of asphalt under the light it was traced in); what
the ground here has more or less of each channel, so has the asset.
"""

from __future__ import annotations

from dataclasses import asdict, replace

import torch

from scenes.asset import Asset
from scenes.detail import as_seen
from scenes.gaussians import Gaussians
from scenes.harmonics import rgb_from_sh, sh_from_rgb
from scenes.scene import Scene
from scenes.sky import linear_from_srgb, srgb_from_linear
from scenes.trajectory import Trajectory

ASPHALT = 0.13
"""Albedo of worn asphalt: 0.1 to 0.15."""

AROUND = 6.0
"""Metres within which the ground is taken."""

FEWEST = 30
"""Splats that tell the ground's colour."""

LIMIT = 4.0
"""Times brighter or darker at most: beyond, something else than asphalt was measured."""


def ground_linear(scene: Scene, xy: torch.Tensor) -> torch.Tensor | None:
    """Linear colour `[3]` of the ground around a world point `[2]`, before the cameras' exposures; None where too little is known."""
    placed = scene.background
    pose = placed.world_from_local.float()
    means = placed.gaussians.means @ pose[:3, :3].T + pose[:3, 3]
    near = (means[:, :2] - xy.float()).norm(dim=1) < AROUND
    near &= torch.sigmoid(placed.gaussians.logit_opacities) > 0.3
    if int(near.sum()) < FEWEST:
        return None
    heights = means[near, 2]
    ground = scene.ground.height(means[near, :2]).float() if scene.ground is not None else heights.quantile(0.2)
    low = (heights - ground).abs() < 0.2
    if int(low.sum()) < FEWEST:
        return None
    colours = rgb_from_sh(placed.gaussians.sh[near, 0][low]).clamp(0, 1)
    return linear_from_srgb(colours).median(0).values


def at_place(asset: Asset, scene: Scene, path: Trajectory, moment_us: int) -> Asset:
    """The asset as it looks on its path: in the light of where that is at a moment, or nearest to it, and without detail that
    no recorded camera could show."""
    first = int((path.times_us - moment_us).abs().argmin())
    lit = matched(asset, scene, path.world_from_body[first, :2, 3])
    return replace(lit, gaussians=as_seen(lit.gaussians, scene, path))


def matched(asset: Asset, scene: Scene, xy: torch.Tensor) -> Asset:
    """The asset in the light of a place `[2]` of a scene; as it is where either ground is unknown. What it is multiplied by, in all since
    it was cut out on a ground of `meta["cut_out_linear"]`, is its `meta["light_gain"]`, and what that would be without `LIMIT`, where this
    tells, `meta["light_wanted"]`."""
    there, here = asset.meta.get("cut_out_linear", asset.meta.get("ground_linear")), ground_linear(scene, xy)
    if there is None or here is None:
        return asset
    before = torch.tensor(asset.meta["light_gain"] if "cut_out_linear" in asset.meta else [1.0, 1.0, 1.0])  # at the places where it was
    wanted = here / torch.tensor(there).clamp_min(1e-3)
    gain = wanted.clamp(1 / LIMIT, LIMIT)
    held = not torch.equal(gain, wanted)
    if not held and "light_wanted" not in asset.meta and float((gain / before - 1).abs().max()) < 0.02:
        return asset
    told = {"cut_out_linear": there, "ground_linear": here.tolist(), "light_gain": [round(g, 4) for g in gain.tolist()]}
    meta = {key: value for key, value in asset.meta.items() if key != "light_wanted"} | told
    if held:
        meta["light_wanted"] = [round(g, 4) for g in wanted.tolist()]
    return replace(asset, gaussians=relit(asset.gaussians, gain / before), meta=meta)


def light_held(name: str, asset: Asset, scene: Scene) -> list[str]:
    """What to tell of an asset that goes by `name`, as `matched` left it, whose light should change by more than `LIMIT`: a sentence, or
    none."""
    wanted = asset.meta.get("light_wanted")
    if not wanted:
        return []
    where = str(scene.meta.get("name", "the scene"))
    asked = ", ".join(f"{gain:.2g}" for gain in wanted)
    said = f"{name} should be {asked} times as bright (red, green, blue) to match the ground of {where} where it stands, but the limit is"
    return [f"{said} {LIMIT:g} times brighter or darker: look whether that ground is a street, and in what light it was taken"]


def other_model(name: str, asset: Asset, scene: Scene) -> list[str]:
    """What to tell of an asset that goes by `name` where its splats were trained to be drawn otherwise than the scene's: a sentence, or
    none. Not how they are projected: both ways come to the same ellipse, but at the rims of wide lenses, and most files do not say."""
    of_asset, of_scene = (asdict(thing.model) for thing in (asset, scene))
    other = [key for key in of_asset if key != "projection" and of_asset[key] != of_scene[key]]
    if not other:
        return []
    trained, drawn = (", ".join(f"{key} {model[key]}" for key in other) for model in (of_asset, of_scene))
    return [f"{name} was trained with {trained}, but the scene is drawn with {drawn}, so it may look thicker or thinner than it is"]


def relit(splats: Gaussians, gain: torch.Tensor) -> Gaussians:
    """Splats whose linear light is multiplied by `gain` `[3]`. What changes with the view changes as the curve to sRGB does there."""

    def change(colour: torch.Tensor) -> torch.Tensor:
        return srgb_from_linear(linear_from_srgb(colour) * gain)

    base = rgb_from_sh(splats.sh[:, :1])
    shown = base.clamp(0.01, 1.0)
    slope = (change(shown + 1e-3) - change(shown - 1e-3)) / 2e-3
    constant = sh_from_rgb(change(shown) + slope * (base - shown))
    return replace(splats, sh=torch.cat([constant, splats.sh[:, 1:] * slope], 1))
