"""Corrections of a trajectory between its knots."""

import math

import numpy as np
import torch

from recon.fit.knots import Knots
from scenes.poses import yaw
from scenes.trajectory import Trajectory


def test_corrections_between_knots_are_between_theirs():
    knots = Knots(Trajectory(torch.tensor([0, 100, 300]), torch.eye(4, dtype=torch.float64).repeat(3, 1, 1)))
    knots.deltas = torch.arange(3.0)[:, None].expand(3, 6).clone()
    _, knot, share = knots.base(np.array([0, 50, 200, 300]))
    torch.testing.assert_close(knots.correction(knot, share)[:, 0], torch.tensor([0.0, 0.5, 1.5, 2.0]))
    held_out = Knots(knots.trajectory, torch.tensor([0, 300]))
    held_out.deltas = torch.tensor([[0.0], [3.0]]).expand(2, 6).clone()
    shift = held_out.corrected(0.0, 0.1).world_from_body[:, 0, 3]
    torch.testing.assert_close(shift, torch.tensor([0.0, 0.1, 0.3], dtype=torch.float64))


def test_beyond_the_first_and_last_knot_corrections_are_held():
    path = Trajectory(torch.arange(4) * 100, torch.eye(4, dtype=torch.float64).repeat(4, 1, 1))
    knots = Knots(path, torch.tensor([100, 200]))
    knots.deltas = torch.tensor([[1.0], [3.0]]).expand(2, 6).clone()
    assert knots.corrected(0.0, 1.0).world_from_body[:, 0, 3].tolist() == [1.0, 1.0, 3.0, 3.0]


def test_a_correction_is_along_the_bodys_own_axes():
    knots = Knots(Trajectory(torch.tensor([0, 100]), torch.stack([yaw(0.0), yaw(math.pi / 2)])))
    knots.deltas = torch.tensor([0.0, 0, 0, 1, 0, 0]).expand(2, 6).clone()
    torch.testing.assert_close(knots.corrected(0.0, 0.5).world_from_body[:, :2, 3], torch.tensor([[0.5, 0], [0, 0.5]], dtype=torch.float64))
