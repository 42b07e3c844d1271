"""Other light: random skies with and without a sun, and what a surface of known direction would look like under them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch.nn import functional as F

from scenes.light import light_of
from scenes.scene import Scene
from scenes.sky import LUMINANCE, Sky, linear_from_srgb, srgb_from_linear

BOUNCE = 0.2
"""Albedo of the street that lights what faces down."""

LEVEL = 0.15
"""Sine of the elevation under which light counts as coming from there: a sun at the horizon would light walls without bound."""

MOST = 3.0
"""Times that a surface gets brighter or darker at most: beyond, its photo has nothing left to show."""

ROWS = 64


@dataclass(frozen=True)
class Illumination:
    """Unit `directions` `[K, 3]` of light, up into the world; the colour `[K, 3]` each sheds on level ground, 1 in luminance in all."""

    directions: torch.Tensor
    colours: torch.Tensor

    @classmethod
    def of(cls, scene: Scene) -> Illumination:
        """That of a scene's sky and sun (`light_of`); the sun is white, the sky as its image."""
        light = light_of(scene)
        colours = torch.ones(len(light.directions), 3, dtype=torch.float64)
        if scene.sky is not None:
            colours = linear_from_srgb(scene.sky.colour(light.directions)).double().clamp_min(1e-4)
        if light.sun is not None:
            colours = torch.where((light.directions @ light.sun > math.cos(math.radians(1)))[:, None], 1.0, colours)
        return cls(light.directions, colours / (colours @ colours.new_tensor(LUMINANCE))[:, None] / len(colours))

    def on(self, normals: torch.Tensor) -> torch.Tensor:
        """Irradiance `[..., 3]` of surfaces by their normals `[..., 3]` in the world, against that of level ground."""
        facing = (normals.double() @ self.directions.T).clamp_min(0) / self.directions[:, 2].clamp_min(LEVEL)
        below = BOUNCE * (1 - normals[..., 2:].double()) / 2
        return (facing @ self.colours + below * self.colours.sum(0)).to(normals)


def relit(rgb: torch.Tensor, normals: torch.Tensor, mask: torch.Tensor, before: Illumination, after: Illumination, gain: float):
    """`rgb` `[H, W, 3]` with what `mask` `[H, W]` in 0..1 covers under another light, times `gain`; `normals` `[H, W, 3]` in the world.

    The photo is albedo times irradiance, so the ratio of irradiances relights it without the albedo ever being known; exact where the
    mask is 0. Shadows and glints stay where the old light put them.
    """
    at = mask > 0
    ratio = (gain * after.on(normals[at]) / before.on(normals[at]).clamp_min(1e-3)).clamp(1 / MOST, MOST)
    photo, out = rgb[at], rgb.clone()
    out[at] = photo + mask[at][:, None] * (srgb_from_linear(linear_from_srgb(photo) * ratio).clamp(0, 1) - photo)
    return out


def smoothed(normals: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Unit normals `[H, W, 3]` averaged over a twelfth of the extent of `mask` `[H, W]`, within it: single splats point anywhere."""
    reach = max(1, round(float(mask.sum()) ** 0.5 / 24))
    planes = (normals * mask[..., None]).permute(2, 0, 1)[None]
    planes = F.avg_pool2d(planes, (1, 2 * reach + 1), 1, (0, reach))
    planes = F.avg_pool2d(planes, (2 * reach + 1, 1), 1, (reach, 0))
    return F.normalize(planes[0].permute(1, 2, 0), dim=-1)


def random_sky(rng: np.random.Generator, skies: Sequence[Sky] = ()) -> Sky:
    """One of `skies` turned round at random, or a made-up one: from a closed grey cover to a blue sky with a sharp low sun."""
    if skies and rng.random() < 0.5:
        picked = skies[int(rng.integers(len(skies)))]
        return Sky(picked.linear.roll(int(rng.integers(picked.linear.shape[1])), 1))
    up = torch.linspace(1, -1, ROWS)[:, None, None]
    blue = float(rng.uniform(0, 1))
    zenith = torch.tensor([1 - 0.75 * blue, 1 - 0.5 * blue, 1.0]) * 0.5
    horizon = torch.tensor([0.8, 0.82, 0.85]) + torch.tensor([0.3, 0.05, -0.3]) * float(rng.uniform(0, 0.6)) * blue
    linear = torch.where(up > 0, torch.lerp(horizon, zenith, up.clamp_min(0) ** 0.5), torch.tensor([0.15, 0.15, 0.15]))
    linear = linear.expand(ROWS, 2 * ROWS, 3).clone()
    if rng.random() < 0.75:
        _add_sun(linear, math.asin(rng.uniform(0.25, 0.95)), rng)
    return Sky(linear.float())


def _add_sun(linear: torch.Tensor, elevation: float, rng: np.random.Generator) -> None:
    """A round sun with 30 to 85 percent of the light on level ground: sharp, or wide as behind haze."""
    height, width = linear.shape[:2]
    angle = math.pi * (0.5 - (torch.arange(height) + 0.5) / height)
    around = 2 * math.pi * (torch.arange(width) + 0.5) / width - rng.uniform(0, 2 * math.pi)
    cosine = angle.sin()[:, None] * math.sin(elevation) + angle.cos()[:, None] * math.cos(elevation) * around.cos()
    disc = cosine > math.cos(math.radians(rng.choice([2.5, 5.0])))
    shed = (angle.sin().clamp_min(0) * angle.cos())[:, None].expand(height, width)
    share = rng.uniform(0.3, 0.85)
    sky = float((linear.mean(-1) * shed).sum())
    warm = torch.tensor([1.0, 0.96 - 0.2 * math.cos(elevation) ** 4, 0.9 - 0.4 * math.cos(elevation) ** 4])
    linear[disc] += warm * share / (1 - share) * sky / float(shed[disc].sum())


def under(scene: Scene, sky: Sky | None) -> Scene:
    """The scene with another sky as its only light: its clock and place no longer tell a sun; as it is where `sky` is None."""
    if sky is None:
        return scene
    return replace(scene, sky=sky, meta={k: v for k, v in scene.meta.items() if k != "geodetic_origin"})
