"""How finely cameras see what is somewhere: by the sharpest of them, from where the path comes nearest."""

import numpy as np
import pytest
import torch

from recon.fit.densify import LARGEST
from recon.fit.reach import NEAREST, reach_at, reach_of
from scenes.camera import RigCamera
from scenes.gaussians import Gaussians
from scenes.lenses import Pinhole
from scenes.trajectory import Trajectory

PATH = Trajectory(torch.tensor([0, 1_000_000]), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))
PATH.world_from_body[1, 0, 3] = 20.0
RIG = [RigCamera(Pinhole(focal, focal, 32.0, 18.0), 64, 36, torch.eye(4, dtype=torch.float64)) for focal in (500.0, 2000.0)]


def test_the_sharpest_camera_tells_from_the_nearest_place_of_the_path_and_never_from_nearer_than_three_metres():
    places = np.array([[20.0, 8.0, 0.0], [0.0, 0.0, 40.0], [0.0, 0.5, 0.0]])
    np.testing.assert_allclose(reach_at(places, PATH, RIG), 1000 / 2000 * np.array([8.0, 40.0, NEAREST]))


@pytest.mark.parametrize(("wide", "times"), [(0.5, 1.0), (2.0, 2.0)])
def test_splats_wider_than_cameras_can_tell_reach_as_far_as_suits_them(wide, times):
    """Ground that no camera saw must not be cut down to leave gaps."""
    usual = 1000 / 2000 * 8.0
    scales = torch.tensor([[wide * LARGEST * usual, 0.01, 0.01]]).log()
    one = Gaussians(torch.tensor([[20.0, 8.0, 0.0]]), torch.tensor([[1.0, 0, 0, 0]]), scales, torch.zeros(1), torch.zeros(1, 1, 3))
    assert float(reach_of(one, PATH, RIG)) == pytest.approx(times * usual)
