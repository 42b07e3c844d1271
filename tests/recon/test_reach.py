"""How finely cameras see what is somewhere: by the sharpest of them, from where the path comes nearest."""

import numpy as np
import pytest
import torch

from recon.fit.densify import LARGEST
from recon.fit.openings import ASIDE, aside_of
from recon.fit.reach import NEAREST, WIDER, held_back, nearest_of, reach_at, reach_of
from recon.seeds.measured import Measured
from scenes.camera import RigCamera
from scenes.gaussians import Gaussians
from scenes.lenses import Pinhole
from scenes.trajectory import Trajectory

PATH = Trajectory(torch.tensor([0, 1_000_000]), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))
PATH.world_from_body[1, 0, 3] = 20.0
RIG = [RigCamera(Pinhole(focal, focal, 32.0, 18.0), 64, 36, torch.eye(4, dtype=torch.float64)) for focal in (500.0, 2000.0)]


def test_the_sharpest_camera_tells_from_the_nearest_place_of_the_path_and_never_from_nearer_than_three_metres():
    places = np.array([[20.0, 8.0, 0.0], [0.0, 0.0, 40.0], [0.0, 0.5, 0.0]])
    np.testing.assert_allclose(reach_at(places, PATH, RIG, NEAREST), 1000 / 2000 * np.array([8.0, 40.0, NEAREST]))


@pytest.mark.parametrize(("wide", "times"), [(0.5, 1.0), (2.0, 2.0)])
def test_splats_wider_than_cameras_can_tell_reach_as_far_as_suits_them(wide, times):
    """Ground that no camera saw must not be cut down to leave gaps."""
    usual = 1000 / 2000 * 8.0
    scales = torch.tensor([[wide * LARGEST * usual, 0.01, 0.01]]).log()
    one = Gaussians(torch.tensor([[20.0, 8.0, 0.0]]), torch.tensor([[1.0, 0, 0, 0]]), scales, torch.zeros(1), torch.zeros(1, 1, 3))
    assert float(reach_of(one, PATH, RIG, NEAREST)) == pytest.approx(times * usual)


@pytest.mark.parametrize(("depths", "nearest", "aside"), [((4.0, 60.0), NEAREST, ASIDE), ((0.5, 4.5), 0.9, 1.5), ((), NEAREST, ASIDE)])
def test_indoors_things_are_seen_from_nearer_and_walls_stand_closer(depths, nearest, aside):
    """By how near the pictures show what they show; on a street, and where nothing is known, a car's metres stay."""
    shown = torch.linspace(*depths, 4001)[None].repeat_interleave(4, 0) if depths else torch.full((4, 8), torch.nan)
    measured = [Measured({(0, 0): shown.half()}, 1.0)]
    assert nearest_of(measured) == pytest.approx(nearest, rel=0.01) and aside_of(measured) == pytest.approx(aside, rel=0.01)


def test_what_no_picture_shows_may_hardly_grow_wider_than_it_is_seeded():
    places, wide = torch.tensor([[20.0, 8.0, 0.0], [20.0, 9.0, 0.0]]), 0.05
    splats = Gaussians(places, torch.tensor([[1.0, 0, 0, 0]] * 2), torch.full((2, 3), wide).log(), torch.zeros(2), torch.zeros(2, 1, 3))
    reach = reach_of(splats, PATH, RIG, NEAREST)
    shown, hidden = held_back(reach, splats, places[1:].double().numpy()).tolist()
    assert shown == reach[0] and hidden * LARGEST == pytest.approx(WIDER * wide) and hidden < reach[1]
    assert held_back(reach, splats, np.zeros((0, 3))) is reach
