"""The sun by the clock and in the sky, and the directions that stand for a sky."""

import math
from dataclasses import replace
from datetime import UTC, datetime

import pytest
import torch

from scenes import Gaussians, Placed, Sky
from scenes.edit import unparked
from scenes.harmonics import sh_from_rgb
from scenes.hdr import load_hdr
from scenes.light import COUNT, clear_sky_share, clearness, disc, light_of, shadows_beside_parked, solar_position, sun_of_sky
from scenes.poses import translation, yaw
from scenes.sky import srgb_from_linear


def at(*when) -> int:
    return int(datetime(*when, tzinfo=UTC).timestamp() * 1e6)


@pytest.mark.parametrize(
    ("when", "place", "elevation", "azimuth"),
    [
        ((2003, 10, 17, 19, 30, 30), (39.742476, -105.1786), 39.872, 194.340),  # NREL's SPA report, table A5.1, without refraction
        ((2024, 3, 20, 3, 6, 20), (90.0, 0.0), 0.0, None),  # the equinox, seen from the pole
        ((2024, 6, 20, 12, 2, 0), (51.4769, 0.0), 61.96, 180.0),  # solstice: 90 - latitude + tilt
        ((2024, 12, 21, 0, 0, 0), (-90.0, 0.0), 23.44, None),  # a summer's midnight at the south pole
    ],
)
def test_the_sun_stands_where_almanacs_say(when, place, elevation, azimuth):
    high, around = (math.degrees(a) for a in solar_position(at(*when), *place))
    assert high == pytest.approx(elevation, abs=0.05)
    if azimuth is not None:
        assert around == pytest.approx(azimuth, abs=0.3)


def sun_in(sky: Sky, row: int, column: int, strength: float) -> Sky:
    linear = sky.linear.clone()
    linear[row, column] = strength
    return Sky(linear)


GREY = Sky(torch.full((64, 128, 3), 0.5))


def test_a_sun_in_the_image_is_found_and_gets_its_share(street):
    for row, column in ((20, 10), (28, 64), (8, 100)):
        yaw, high = math.pi * (1 - (2 * column + 1) / 128), math.pi * (0.5 - (row + 0.5) / 64)
        expected = [math.cos(high) * math.cos(yaw), math.cos(high) * math.sin(yaw), math.sin(high)]
        assert sun_of_sky(sun_in(GREY, row, column, 2000.0)).tolist() == pytest.approx(expected, abs=1e-3)
        solid = (math.sin(high + math.pi / 128) - math.sin(high - math.pi / 128)) * 2 * math.pi / 128
        strength = 0.5 * math.pi / (solid * math.sin(high))  # as much light on the ground as all the grey sky's
        light = light_of(replace(street, sky=sun_in(GREY, row, column, strength)))
        near = (light.directions @ torch.tensor(expected, dtype=torch.float64)) > math.cos(0.03)
        assert float(near.double().mean()) == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize(("height", "radius"), [(8, 0), (64, 6)])
def test_a_sun_that_fills_all_that_is_near_it_stands_at_its_brightest(height, radius):
    """Of one pixel in a coarse sky, and of many in a fine one."""
    linear, row = torch.full((height, 2 * height, 3), 0.3), height // 4
    linear[row - radius : row + radius + 1, height - radius : height + radius + 1] = 30.0
    linear[row, height] = 31.0
    yaw, high = -math.pi / (2 * height), math.pi * (0.5 - (row + 0.5) / height)
    expected = [math.cos(high) * math.cos(yaw), math.cos(high) * math.sin(yaw), math.sin(high)]
    assert sun_of_sky(Sky(linear)).tolist() == pytest.approx(expected, abs=1e-6)


def test_no_sun_is_made_up_where_the_sky_shows_none(street):
    assert sun_of_sky(GREY) is None and sun_of_sky(street.sky) is None
    assert light_of(street).sun is None and light_of(replace(street, sky=None)).sun is None
    assert light_of(replace(street, sky=Sky(torch.zeros(16, 32, 3)))).sun is None


def test_an_even_sky_lights_the_ground_by_the_cosine(street):
    directions = light_of(replace(street, sky=None)).directions
    assert directions.shape == (COUNT, 3) and (directions[:, 2] > 0).all()
    torch.testing.assert_close(directions.norm(dim=1), torch.ones(COUNT, dtype=torch.float64))
    # of light by the cosine the mean height is 2/3, and as much comes from every side
    assert directions.mean(0).tolist() == pytest.approx([0, 0, 2 / 3], abs=0.03)


def test_place_and_time_put_the_sun_into_a_blue_sky_only(street):
    blue, closed = torch.tensor([0.2, 0.35, 0.6]).expand(32, 64, 3).contiguous(), torch.full((32, 64, 3), 0.6)
    here = {**street.meta, "geodetic_origin": {"lat": 37.776, "long": -122.399, "height": 3.0}}
    noon = replace(street.ego, times_us=street.ego.times_us - street.ego.times_us[0] + at(2019, 5, 10, 20, 0, 0))
    day = replace(street, meta=here, ego=noon, sky=Sky(blue))
    light = light_of(day)
    assert light.sun[2] > 0.9 and light.sun[1] < 0  # at noon the sun is high in the south
    assert "by time and place" in light.source
    assert light_of(replace(day, sky=Sky(closed))).sun is None and clearness(Sky(closed)) == 0
    night = replace(noon, times_us=noon.times_us + 12 * 3_600_000_000)
    assert light_of(replace(day, ego=night)).sun is None
    assert 0.75 < clear_sky_share(1.2) < 0.95 and clear_sky_share(0.1) < clear_sky_share(0.5)


@pytest.mark.parametrize(("hour", "east"), [(16, 1), (23, -1)])
def test_the_sun_stands_in_the_east_in_the_morning_and_in_the_west_in_the_evening(street, hour, east):
    """Of a world whose x is east, in San Francisco, 8 hours behind the clock: its shadows fall to the other side."""
    here = {**street.meta, "geodetic_origin": {"lat": 37.776, "long": -122.399, "height": 3.0}}
    then = replace(street.ego, times_us=street.ego.times_us - street.ego.times_us[0] + at(2019, 5, 10, hour, 0, 0))
    sun = light_of(replace(street, meta=here, ego=then, sky=Sky(torch.tensor([0.2, 0.35, 0.6]).expand(32, 64, 3).contiguous()))).sun
    assert east * sun[0] > 0.6 and 0.3 < sun[2] < 0.8


def test_parked_cars_tell_whether_the_sun_reaches_the_street(street):
    """Cars along a road whose ground is dark on the far side from the sun, or as bright on both."""
    sun = torch.tensor([0.0, 0.8, 0.6], dtype=torch.float64)
    boxes = [translation(float(x)).tolist() for x in range(0, 50, 10)]
    parked = [{"track": f"veh_{i}", "label": "car", "size": [4.2, 1.8, 1.5], "world_from_box": b} for i, b in enumerate(boxes)]
    ground = street.background.gaussians.select(street.background.gaussians.means[:, 2] == 0)
    ground = Gaussians.cat([ground.map(lambda t: t)] * 3)
    for dim, expected in ((0.4, 0.6), (1.5, 0.0), (1.0, 0.0)):
        shaded = (ground.means[:, 1] < -0.9) & (ground.means[:, 1] > -3.1)
        colour = srgb_from_linear(torch.where(shaded[:, None], 0.2 * dim, 0.2)).expand(-1, 3)
        scene = replace(
            street, meta={**street.meta, "parked": parked},
            background=Placed(replace(ground, sh=sh_from_rgb(colour)[:, None].contiguous()), street.background.world_from_local),
        )  # fmt: skip
        assert shadows_beside_parked(scene, sun) == pytest.approx(expected, abs=0.02)
        gone = replace(scene, meta=unparked(scene.meta, ["veh_1", "veh_2", "veh_3"]))
        assert len(gone.meta["parked"]) == 2 and shadows_beside_parked(gone, sun) == pytest.approx(expected, abs=0.02)
    here = {"geodetic_origin": {"lat": 37.776, "long": -122.399, "height": 3.0}}
    noon = replace(street.ego, times_us=street.ego.times_us - street.ego.times_us[0] + at(2019, 5, 10, 20, 0, 0))
    blue = Sky(torch.tensor([0.2, 0.35, 0.6]).expand(32, 64, 3).contiguous())
    told = [light_of(replace(scene, ego=noon, sky=blue, meta={**here, **more})).sun for more in ({}, {"parked": parked})]
    assert told[0] is not None and told[1] is None, "a sun that casts no shadows is behind houses that nobody saw"
    assert shadows_beside_parked(street, sun) is None
    assert shadows_beside_parked(replace(scene, meta={"parked": parked[:2]}), sun) is None


def test_shadows_are_looked_for_past_the_end_of_a_car_that_points_at_the_sun(street):
    """Cars at an angle across the road, and the sun behind their tails: 2 m of shade before their noses."""
    way = torch.tensor([math.sqrt(0.5), math.sqrt(0.5)])
    boxes = [translation(float(x), y) @ yaw(math.pi / 4) for x in (5, 15, 25) for y in (-4.0, 4.0)]
    parked = [{"track": "veh", "label": "car", "size": [4.2, 1.8, 1.5], "world_from_box": b.tolist()} for b in boxes]
    ground = street.background.gaussians.select(street.background.gaussians.means[:, 2] == 0)
    off = ground.means[:, None, :2] - torch.stack([b[:2, 3] for b in boxes]).float()
    along, aside = off @ way, off @ torch.stack([-way[1], way[0]])
    shaded = ((along > 2.1) & (along < 4.1) & (aside.abs() < 1)).any(1)
    colour = srgb_from_linear(torch.where(shaded[:, None], 0.08, 0.2)).expand(-1, 3)
    splats = Placed(replace(ground, sh=sh_from_rgb(colour)[:, None].contiguous()), street.background.world_from_local)
    scene = replace(street, meta={**street.meta, "parked": parked}, background=splats)
    sun = torch.tensor([*(-0.8 * way), 0.6], dtype=torch.float64)
    assert shadows_beside_parked(scene, sun) == pytest.approx(0.6, abs=0.05)


@pytest.mark.parametrize(("sun_share", "least", "most"), [(0.0, 0.0, 0.0), (0.6, 0.1, 0.6)])
def test_a_pale_pavement_is_no_sun_and_hides_none(street, sun_share, least, most):
    """Cars at both kerbs of a road along x, its pavements twice as bright: only a sun darkens the same side of all cars."""
    sun = torch.tensor([0.0, 0.8, 0.6], dtype=torch.float64)
    boxes = [translation(float(x), y) for y in (-5.0, 5.0) for x in range(0, 50, 10)]
    parked = [{"track": "veh", "label": "car", "size": [4.2, 1.8, 1.5], "world_from_box": b.tolist()} for b in boxes]
    ground = street.background.gaussians.select(street.background.gaussians.means[:, 2] == 0)
    ground = Gaussians.cat([ground] * 3)
    y = ground.means[:, 1]
    albedo = torch.where(y.abs() > 5, 0.4, 0.2)
    shaded = ((y + 5) < -0.9) & ((y + 5) > -3.1) | ((y - 5) < -0.9) & ((y - 5) > -3.1)
    colour = srgb_from_linear((albedo * torch.where(shaded, 1 - sun_share, 1.0))[:, None]).expand(-1, 3)
    splats = Placed(replace(ground, sh=sh_from_rgb(colour)[:, None].contiguous()), street.background.world_from_local)
    scene = replace(street, meta={**street.meta, "parked": parked}, background=splats)
    assert least <= shadows_beside_parked(scene, sun) <= most


def test_a_disc_stays_within_its_radius_and_fills_it():
    for middle in ([0.0, 0, 1], [0.6, 0, 0.8], [0.0, -1, 0]):
        middle = torch.tensor(middle, dtype=torch.float64)
        angles = (disc(middle, 0.05, 400) @ middle).clamp(-1, 1).acos()
        assert angles.max() < 0.05 and float(angles.square().mean()) == pytest.approx(0.05**2 / 2, rel=0.02)


def test_the_suns_of_real_skies_are_found(shared):
    height = {n: float(sun_of_sky(Sky(load_hdr(shared / "envmaps" / f"{n}_1k.hdr")))[2]) for n in ("venice_sunset", "rooitou_park")}
    assert 0 < height["venice_sunset"] < 0.1 < height["rooitou_park"] < 0.3
