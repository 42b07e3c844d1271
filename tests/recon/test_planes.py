"""Depths by planes that lie as a street's surfaces do."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from recon.seeds import planes
from recon.seeds.stereo import Plate
from recon.seeds.volume import Volume

HEIGHT, WIDTH, FOCAL = 96, 128, 100.0
EYE, BESIDE = 1.6, 4.0
FLU = np.array([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])
NOWHERE = np.zeros((0, 3))


def plate(x: float, roll: float = 0.0) -> Plate:
    """A corridor as it is seen from x metres along it: a road, and walls 4 m to both sides."""
    turned = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    cam_from_world = np.eye(4)
    cam_from_world[:3, :3] = turned @ FLU
    cam_from_world[:3, 3] = -cam_from_world[:3, :3] @ [x, 0, EYE]
    made = Plate(
        torch.zeros(HEIGHT, WIDTH), (FOCAL, FOCAL), (WIDTH / 2, HEIGHT / 2), cam_from_world, torch.zeros(HEIGHT, WIDTH, 2), np.ones(1, bool)
    )
    depth, on_wall = truth(made)
    at = np.array([x, 0, EYE]) + depth[..., None] * (made.rays().numpy() @ cam_from_world[:3, :3])
    paint = np.random.default_rng(0).uniform(-60, 60, (2, 400, 200))
    across = np.where(on_wall, at[..., 2], at[..., 1] + BESIDE)
    places = np.stack([on_wall + 0.0, (at[..., 0] + 20) * 4, across * 4 + 100 * (at[..., 1] > 0) * on_wall])
    grey = ndimage.map_coordinates(paint, places, order=1, mode="nearest")
    return Plate(torch.from_numpy(grey).float(), made.focal, made.centre, cam_from_world, made.at, made.inside)


def truth(seen: Plate) -> tuple[np.ndarray, np.ndarray]:
    """Depth z `[h, w]` of the corridor, and which pixels show its walls."""
    ahead = seen.rays().double().numpy() @ seen.cam_from_world[:3, :3]
    with np.errstate(divide="ignore"):
        wall, road = BESIDE / np.abs(ahead[..., 1]), np.where(ahead[..., 2] < 0, -EYE / ahead[..., 2], np.inf)
    return np.minimum(wall, road), wall < road


def right(found: np.ndarray, seen: Plate, wall: bool) -> float:
    """Share of the pixels nearer than 25 m, of walls or of the road, that are found within 3 % of their depth."""
    depth, on_wall = truth(seen)
    asked = (on_wall == wall) & (depth < 25)
    return float((np.abs(found / depth - 1) < 0.03)[asked].mean())


@pytest.mark.parametrize("roll", [0.0, 0.3])
def test_a_street_is_known_from_pictures_that_stand_far_apart(roll, monkeypatch):
    own, others = plate(0.0, roll), [plate(-4.0, roll), plate(4.0, roll)]
    road = truth(own)[0] + 0.5
    found = planes.swept(own, others, 2.0, NOWHERE, road)
    monkeypatch.setattr(planes, "_directions", lambda *_, of=planes._directions: of(*_)[:1])
    facing = planes.swept(own, others, 2.0, NOWHERE, road)
    for wall in (False, True):
        assert right(found, own, wall) > max(0.6, right(facing, own, wall) + 0.2), wall


def test_where_the_road_is_not_known_it_is_found_all_the_same():
    own = plate(0.0)
    found = planes.swept(own, [plate(-1.5), plate(1.5)], 2.0, NOWHERE, np.full((HEIGHT, WIDTH), np.inf))
    assert min(right(found, own, wall) for wall in (False, True)) > 0.5


def test_pictures_from_one_above_the_other_have_no_walls_along_their_way():
    own = plate(0.0)
    lift = np.eye(4)
    lift[1, 3] = 0.5
    above = Plate(own.grey, own.focal, own.centre, lift @ own.cam_from_world, own.at, own.inside)
    assert len(planes._directions(own, [above], torch.ones(HEIGHT, WIDTH))) == 2


@pytest.mark.parametrize(("times", "found"), [(1.3, True), (2.0, False)])
def test_planes_of_the_road_are_not_tried_far_above_it(times, found):
    own, others = plate(0.0), [plate(-1.5), plate(1.5)]
    depth, on_wall = truth(own)
    limit = torch.from_numpy(1 / (times * depth)).float()
    _, road, _ = planes._directions(own, others, limit)
    cost, inverse_depth = planes._along(road, Volume(own, others), 0.5, planes._known(own, NOWHERE), limit)
    asked = ~on_wall & (depth < 6)
    right = (np.abs(1 / inverse_depth.numpy() / depth - 1) < 0.03) & (cost.numpy() < 1)
    assert right[asked].mean() > 0.8 if found else not right[asked].any()


def test_of_several_points_in_a_pixel_the_last_counts_on_any_number_of_threads():
    seen = Plate(torch.zeros(6, 8), (8.0, 8.0), (4.0, 3.0), np.eye(4), torch.zeros(6, 8, 2), np.ones((6, 8), bool))
    rng = np.random.default_rng(0)
    depth = rng.uniform(1, 40, 20_000)
    points = np.stack([rng.uniform(-0.5, 0.5, 20_000), rng.uniform(-0.375, 0.375, 20_000), np.ones(20_000)], 1) * depth[:, None]
    row, column, z, inside = seen.shown(points)
    last = np.full((6, 8), np.nan)
    for r, c, d in zip(row[inside], column[inside], z[inside], strict=True):
        last[r, c] = d
    np.testing.assert_allclose(planes._known(seen, points).numpy(), 1 / last, rtol=1e-6)
