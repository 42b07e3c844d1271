import numpy as np
import torch

from recon.ground import estimate_ground
from scenes.poses import translation
from scenes.trajectory import Trajectory


def path():
    return Trajectory(torch.arange(20) * 100_000, torch.stack([translation(float(i), 0.0, 0.3 + 0.02 * i) for i in range(20)]))


def street_points(generator, count=60_000):
    xy = generator.uniform([-30, -20], [50, 20], (count, 2))
    return np.concatenate([xy, (0.02 * xy[:, :1]) + generator.normal(0, 0.01, (count, 1))], 1)


def test_a_sloped_street_is_found_under_cars_and_beside_walls():
    generator = np.random.default_rng(0)
    points = street_points(generator)
    points = points[~((np.abs(points[:, 0] - 10) < 2.2) & (np.abs(points[:, 1] - 4) < 1))]  # in the car's shadow
    car = generator.uniform([7.8, 3, 0.6], [12.2, 5, 1.9], (3000, 3))
    wall = generator.uniform([-30, 15, 0], [50, 15.2, 8], (20_000, 3))
    ground = estimate_ground(np.concatenate([points, car, wall]), path())
    for x, y in ((0, 0), (10, 4), (20, -8), (-15, 5), (30, 10)):
        assert abs(float(ground.height(torch.tensor([x, y]))) - 0.02 * x) < 0.08


def test_every_cell_is_filled_even_far_from_any_point():
    ground = estimate_ground(street_points(np.random.default_rng(1), 500), path())
    assert torch.isfinite(ground.heights).all()


def test_without_points_the_ground_is_flat_at_the_body():
    ground = estimate_ground(np.zeros((0, 3)), path())
    assert ground.heights.unique().numel() == 1 and 0.3 < float(ground.heights[0, 0]) < 0.8
