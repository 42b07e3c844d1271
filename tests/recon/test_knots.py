"""Corrections of a trajectory between its knots."""

import numpy as np
import torch

from recon.fit.knots import Knots
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
