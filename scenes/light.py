"""Where the light of a scene comes from: the sun in its sky image, or by the clock and the place; and how much of it is the sun's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

import torch

from scenes.harmonics import rgb_from_sh
from scenes.scene import Scene
from scenes.sky import LUMINANCE, Sky, linear_from_srgb, texels

SUN_RADIUS = math.radians(0.266)
"""Of the sun's disc; haze and coarse images only make it wider."""

COUNT = 96
"""Directions that stand for a whole sky."""

LOWEST = math.radians(1.0)
"""Elevation below which the sun is behind something."""

BEYOND = 1.0
"""Metres beyond a parked vehicle at which its shadow is looked for, and within which."""

GOLDEN = math.pi * (3 - math.sqrt(5))

SUN_FROM = 8.0
"""Times the mean radiance of the upper sky from which a sky image shows the sun itself, not a bright cloud."""

BESIDE = math.radians(12)
"""Around the brightest pixel, where what is far brighter than the sky is the sun's."""

CLEAR, OVERCAST = 0.45, 0.1
"""Saturation, (blue - red) / blue of the mean linear sky, of a cloudless sky and of a closed cover."""


@dataclass(frozen=True)
class Light:
    """What lights open level ground: unit `directions` `[K, 3]` float64, up into the world, each with as much of that light as any other.

    sun: towards the sun, `[3]`, or None where none shows; source: how that is known.
    """

    directions: torch.Tensor
    sun: torch.Tensor | None
    source: str


def light_of(scene: Scene) -> Light:
    """The light of a scene's sky image. Where that does not show the sun itself, it is added by time and place, where the scene knows
    them, as strong as the image's blueness tells; without an image the sky is even. The time is the drive's first moment."""
    if scene.sky is None:
        return Light(_drawn(torch.ones(32, 64, dtype=torch.float64), COUNT), None, "an even sky")
    luminance = scene.sky.linear.double() @ torch.tensor(LUMINANCE, dtype=torch.float64)
    seen = sun_of_sky(scene.sky)
    if seen is not None:
        told = f"the sky's image, the sun at {math.degrees(math.asin(float(seen[2]))):.0f} deg"
        return Light(_drawn(luminance, COUNT), seen, told)
    place, clear = scene.meta.get("geodetic_origin"), clearness(scene.sky)
    elevation, azimuth = solar_position(int(scene.ego.times_us[0]), float(place["lat"]), float(place["long"])) if place else (0.0, 0.0)
    # a world with a geodetic origin has x east and y north; azimuth counts from north to the east
    sun = _direction(math.pi / 2 - azimuth, elevation)
    share = clear * clear_sky_share(elevation) if elevation > LOWEST else 0.0
    if share and (cast := shadows_beside_parked(scene, sun)) is not None:
        share = min(share, cast)
    count = round(share * COUNT)
    if not count:
        return Light(_drawn(luminance, COUNT), None, "the sky's image")
    high = f"{math.degrees(elevation):.0f} deg"
    told = f"the sky's image, {clear:.0%} clear, and the sun at {high} by time and place, with {share:.0%} of the light"
    return Light(torch.cat([disc(sun, SUN_RADIUS, count), _drawn(luminance, COUNT - count)]), sun, told)


def sun_of_sky(sky: Sky) -> torch.Tensor | None:
    """Direction `[3]` of the sun in a sky image of true radiances; None where nothing in it is that much brighter than the rest.

    It is the middle of what within 12 degrees of the brightest pixel exceeds the sky around, or that pixel where a coarse image, or a wide
    sun, leaves no such sky.
    """
    directions, solid = texels(*sky.linear.shape[:2])
    up = directions[..., 2] > 0
    luminance = sky.linear.double() @ torch.tensor(LUMINANCE, dtype=torch.float64)
    mean = float((luminance * solid)[up].sum() / solid[up].sum())
    brightest = float((luminance * up).max())
    if brightest < SUN_FROM * max(mean, 1e-9):
        return None
    peak = directions.reshape(-1, 3)[int((luminance * up).argmax())]
    near = up & (directions @ peak > math.cos(BESIDE))
    around = float(luminance[near].median())
    extra = torch.where(near, (luminance - 4 * around).clamp_min(0), torch.zeros_like(luminance)) * solid
    if not extra.any():
        return peak
    centre = (extra[..., None] * directions).sum((0, 1))
    return centre / centre.norm()


def shadows_beside_parked(scene: Scene, sun: torch.Tensor) -> float | None:
    """The part of the light that the ground lacks on the far side from the sun of parked vehicles, of removed ones too, against the near
    side: whether the sun reaches the street at all, where the houses that keep it off were never seen.

    What three in four vehicles show at least: a kerb has pale pavement on one side and dark road on the other, which looks like a shadow
    on one side of the street, and on the other like its opposite; a sun that is there shows on both. None where fewer than 3 tell.
    """
    background, ground = scene.background, scene.ground
    vehicles = [*scene.meta.get("parked", []), *scene.meta.get("parked_once", [])]
    if ground is None or not vehicles:
        return None
    pose, splats = background.world_from_local.float(), background.gaussians.detach().to("cpu")
    means = splats.means @ pose[:3, :3].T + pose[:3, 3]
    low = (means[:, 2] - ground.height(means[:, :2]).float()).abs() < 0.3
    low &= torch.sigmoid(splats.logit_opacities) > 0.3
    places = means[low, :2]
    luminance = linear_from_srgb(rgb_from_sh(splats.sh[low, 0]).clamp(0, 1)).mean(1)
    away = -torch.nn.functional.normalize(sun[:2].float(), dim=0)
    lacking = []
    for vehicle in vehicles:
        box, size = torch.tensor(vehicle["world_from_box"]), torch.tensor(vehicle["size"])
        reach = (box[:2, :2].T @ away).abs() @ size[:2] / 2 + BEYOND
        sides = [luminance[(places - box[:2, 3] - way * reach * away).norm(dim=1) < BEYOND] for way in (1, -1)]
        if min(len(s) for s in sides) >= 3:
            dark, bright = (float(s.median()) for s in sides)
            lacking.append(1 - dark / max(bright, 1e-6))
    if len(lacking) < 3:
        return None
    return max(0.0, sorted(lacking)[len(lacking) // 4])


def disc(middle: torch.Tensor, radius: float, count: int) -> torch.Tensor:
    """`count` unit directions `[count, 3]` evenly within `radius` radians of a unit direction `[3]` (Vogel's sunflower)."""
    i = torch.arange(count, dtype=torch.float64)
    out, around = radius * ((i + 0.5) / count).sqrt(), i * GOLDEN
    side = torch.linalg.cross(middle, torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64) if middle[2] < 0.9 else torch.eye(3).double()[0])
    side = side / side.norm()
    offset = (out * around.cos())[:, None] * side + (out * around.sin())[:, None] * torch.linalg.cross(middle, side)
    return torch.nn.functional.normalize(middle + offset, dim=1)


def _drawn(luminance: torch.Tensor, count: int) -> torch.Tensor:
    """`count` directions `[count, 3]` into the upper half of an equirectangular image `[H, W]`, drawn by the light that each pixel sheds on
    level ground: a column by even steps, then a row by the golden ratio's, as evenly spread as a sky of any brightness allows."""
    directions, solid = texels(*luminance.shape)
    weight = luminance * solid * directions[..., 2].clamp_min(0)
    if not weight.sum() > 0:
        return _drawn(torch.ones_like(luminance), count)
    i = torch.arange(count, dtype=torch.float64)
    columns = weight.sum(0).cumsum(0)
    column = torch.searchsorted(columns, (i + 0.5) / count * columns[-1]).clamp_max(weight.shape[1] - 1)
    rows = weight[:, column].T.cumsum(1)
    row = torch.searchsorted(rows, ((i + 0.5) * 0.6180339887498949 % 1)[:, None] * rows[:, -1:])[:, 0].clamp_max(weight.shape[0] - 1)
    return directions[row, column]


def clearness(sky: Sky) -> float:
    """0 under a closed cover to 1 under a cloudless sky, by how blue the upper half of a sky image is."""
    h = sky.linear.shape[0]
    red, _, blue = sky.linear[: max(1, h // 2)].double().mean((0, 1)).tolist()
    saturation = (blue - red) / max(blue, 1e-9)
    return min(1.0, max(0.0, (saturation - OVERCAST) / (CLEAR - OVERCAST)))


def clear_sky_share(elevation: float) -> float:
    """The sun's part of the light on level ground under a cloudless sky, for its elevation in radians.

    Direct beam 1353 x 0.7 ^ (AM ^ 0.678) W/m2 (Meinel 1976), air mass AM of Kasten and Young 1989, the blue sky a tenth of the beam as if
    from overhead (the usual rule of a tenth), never less than 40 W/m2.
    """
    degrees = math.degrees(elevation)
    air = 1 / (math.sin(elevation) + 0.50572 * (degrees + 6.07995) ** -1.6364)
    beam = 1353 * 0.7 ** (air**0.678)
    return beam * math.sin(elevation) / (beam * math.sin(elevation) + max(0.1 * beam, 40.0))


def solar_position(time_us: int, latitude: float, longitude: float) -> tuple[float, float]:
    """Elevation and azimuth (from north to the east) of the sun in radians, at a unix time and a place in degrees north and east.

    NOAA's solar calculator, after Meeus, Astronomical Algorithms (1998), chapter 25; to 0.02 degrees, without refraction.
    """
    days = (datetime(1970, 1, 1, tzinfo=UTC) + timedelta(microseconds=time_us) - datetime(2000, 1, 1, 12, tzinfo=UTC)) / timedelta(days=1)
    t = days / 36525
    mean_longitude = 280.46646 + t * (36000.76983 + 0.0003032 * t)
    anomaly = math.radians(357.52911 + t * (35999.05029 - 0.0001537 * t))
    centre = (
        (1.914602 - t * (0.004817 + 0.000014 * t)) * math.sin(anomaly)
        + (0.019993 - 0.000101 * t) * math.sin(2 * anomaly)
        + 0.000289 * math.sin(3 * anomaly)
    )
    node = math.radians(125.04 - 1934.136 * t)
    apparent = math.radians(mean_longitude + centre - 0.00569 - 0.00478 * math.sin(node))
    tilt = math.radians(23.439291 - 0.0130042 * t + 0.00256 * math.cos(node))
    declination = math.asin(math.sin(tilt) * math.sin(apparent))
    ascension = math.atan2(math.cos(tilt) * math.sin(apparent), math.cos(apparent))
    sidereal = math.radians(280.46061837 + 360.98564736629 * days)
    hour = sidereal + math.radians(longitude) - ascension
    north = math.radians(latitude)
    sine = math.sin(north) * math.sin(declination) + math.cos(north) * math.cos(declination) * math.cos(hour)
    azimuth = math.atan2(-math.sin(hour), math.tan(declination) * math.cos(north) - math.sin(north) * math.cos(hour))
    return math.asin(max(-1.0, min(1.0, sine))), azimuth % (2 * math.pi)


def _direction(yaw: float, elevation: float) -> torch.Tensor:
    level = math.cos(elevation)
    return torch.tensor([level * math.cos(yaw), level * math.sin(yaw), math.sin(elevation)], dtype=torch.float64)
