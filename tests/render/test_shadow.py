import pytest
import torch
from street import START_US, car

from render.frame_types import Frame
from render.shadow import DARKNESS, REACH, cast, shade_at, shadow_casters
from scenes.insert import insert
from scenes.placement import Placement

HALF = (2.1, 0.9)


def shade(x, y) -> float:
    return float(shade_at(torch.tensor([x, y], dtype=torch.float64), HALF))


def test_the_middle_of_the_footprint_is_darkest():
    assert shade(0, 0) == pytest.approx(DARKNESS)
    assert DARKNESS > shade(HALF[0], 0) > shade(HALF[0] + 0.3, 0) > 0


def test_beyond_its_reach_there_is_no_shadow():
    assert shade(HALF[0] + REACH, 0) == 0
    assert shade(0, HALF[1] + REACH) == 0
    assert shade(HALF[0] + 0.8 * REACH, HALF[1] + 0.8 * REACH) == 0  # corners are round


def test_only_surfaces_near_the_plane_receive_it(street):
    """A pixel that sees the plane, something on it, something high, and nothing at all."""
    camera = street.camera("front_camera", START_US)
    scene = insert(street, car(), Placement("car", 9, 0)).scene
    (caster,) = shadow_casters(scene, camera)
    y, x = 40, 48  # 9 m ahead of the body, under the car
    down = (y + 0.5 - 27) / 57.6
    depths = {"ground": 1.5 / down, "kerb": 1.35 / down, "roof": 0.5 / down, "nothing": float("inf")}
    light = {}
    for name, depth in depths.items():
        flat = torch.full((54, 96), depth)
        frame = Frame(camera, rgb=torch.ones(54, 96, 3), depth=flat, instance=torch.zeros(54, 96, dtype=torch.int32))
        light[name] = float(cast(frame, [caster])[y, x, 0])
    assert light["ground"] == pytest.approx(light["kerb"])
    assert light["ground"] < 0.7
    assert light["roof"] == light["nothing"] == 1


@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (1.0, 0.4), (2.3, 1.0), (0.0, 1.3)])
def test_the_shadow_is_symmetric(x, y):
    assert shade(x, y) == shade(-x, y) == shade(x, -y)


def test_assets_out_of_view_cost_nothing(street):
    camera = street.camera("front_camera", START_US)
    behind = insert(street, car(), Placement("car", -8, 0)).scene
    assert shadow_casters(behind, camera) == []
    ahead = insert(street, car(), Placement("car", 12, 0)).scene
    (caster,) = shadow_casters(ahead, camera)
    x0, y0, x1, y1 = caster.window
    assert 0 <= x0 < 48 < x1 <= 96 and 27 < y1 <= 54
    assert (x1 - x0) * (y1 - y0) < 96 * 54 / 8


def test_an_asset_across_the_camera_plane_may_shade_the_whole_image(street):
    beside = insert(street, car(), Placement("car", 1.5, 2.5)).scene
    (caster,) = shadow_casters(beside, street.camera("front_camera", START_US))
    assert caster.window == (0, 0, 96, 54)
