import numpy as np
import torch

from recon.ground import BARE, GROUND, MOST, STRAY_IN_PICTURES, estimate_ground, shown_ground
from scenes.ground import Ground
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


def test_the_ground_goes_through_the_middle_of_noise():
    """The lowest of a hundred points in each cell lie 6 cm under it."""
    generator = np.random.default_rng(5)
    xy = generator.uniform([-10, -6], [30, 6], (200_000, 2))
    points = np.column_stack([xy, 0.02 * xy[:, 0] + generator.normal(0, 0.03, len(xy))])
    ground = estimate_ground(points, path())
    at = torch.from_numpy(generator.uniform([0, -4], [20, 4], (200, 2)))
    assert abs(float((ground.height(at) - 0.02 * at[:, 0]).mean())) < 0.01


def test_a_street_is_bare_where_lidar_shows_it_and_nothing_on_it():
    generator = np.random.default_rng(3)
    points = street_points(generator, 1_000_000)
    unseen = (points[:, 0] > 28) & (points[:, 1] > 8)
    car = generator.uniform([7.8, 3, 0.4], [12.2, 5, 1.9], (3000, 3))
    kerb = generator.uniform([-30, 10, 0.1], [50, 10.2, 0.7], (20_000, 3))
    wire = generator.uniform([-30, -8, 5], [50, -7.9, 5.1], (3000, 3))
    stray = np.array([[-5.0, -3.0, 0.6]])
    points = np.concatenate([points[~unseen], car, kerb, wire, stray])
    ground = estimate_ground(points, path())
    shown = shown_ground(points, ground)

    def at(x: float, y: float) -> int:
        return int(shown[round((y - ground.origin[1]) / ground.cell), round((x - ground.origin[0]) / ground.cell)])

    assert at(0, 0) == at(20, -3) == at(-5, -3) == BARE, "one stray point stands for nothing"
    assert at(10, 4) == at(7.4, 4) == at(0, 10) == GROUND, "below a car, next to it, at a kerb"
    assert at(0, -8) == BARE, "below a wire"
    assert at(40, 15) == 0, "where lidar shows nothing, nothing is known"


def test_beside_a_step_nothing_is_known_of_the_ground():
    """Between its heights there is none, and what stands below would be drawn up."""
    generator = np.random.default_rng(4)
    xy = generator.uniform([-10, -10], [10, 10], (400_000, 2))
    points = np.column_stack([xy, np.where(xy[:, 1] > 3, -0.6, 0.0) + generator.normal(0, 0.01, len(xy))])
    y, x = np.meshgrid(np.arange(-8, 8.01, 0.5), np.arange(-8, 8.01, 0.5), indexing="ij")
    ground = Ground(torch.from_numpy(np.where(y > 3, -0.6, 0.0)).float(), (-8.0, -8.0), 0.5)
    shown = shown_ground(points, ground)
    rows = [round((height + 8) / 0.5) for height in (0.0, 3.0, 3.5, 6.0)]
    assert [set(shown[row, 1:-1].tolist()) <= {BARE} for row in rows] == [True, False, False, True]
    assert 0 in shown[rows[2], 1:-1].tolist() + shown[rows[1], 1:-1].tolist()


def test_points_that_pictures_agree_on_show_a_street_though_they_are_a_decimetre_off():
    generator = np.random.default_rng(6)
    points = np.column_stack([generator.uniform([-10, -10], [10, 10], (100_000, 2)), generator.normal(0, 0.1, 100_000)])
    ground = Ground(torch.zeros(33, 33), (-8.0, -8.0), 0.5)
    assert (shown_ground(points, ground, STRAY_IN_PICTURES) == BARE).float().mean() > 0.9
    assert (shown_ground(points, ground) == 0).float().mean() > 0.9


def test_of_no_points_nothing_is_known():
    ground = Ground(torch.zeros(4, 4), (0.0, 0.0), 1.0)
    for points in (np.zeros((0, 3)), np.full((5, 3), 100.0)):
        assert not shown_ground(points, ground).any()


def test_every_cell_is_filled_even_far_from_any_point():
    ground = estimate_ground(street_points(np.random.default_rng(1), 500), path())
    assert torch.isfinite(ground.heights).all()


def test_without_points_the_ground_goes_with_the_body_and_on_beyond():
    ground = estimate_ground(np.zeros((0, 3)), path())
    for x, z in ((0.0, 0.3), (10.0, 0.5), (19.0, 0.68), (24.0, 0.78), (-5.0, 0.2), (70.0, 1.08)):
        assert abs(float(ground.height(torch.tensor([x, 3.0]))) - z) < 0.02


def hill(x):
    """A street that climbs 12 in 100, and falls again."""
    return 0.12 * (60 - np.abs(x - 60))


def test_a_street_over_a_hill_is_found_all_along():
    generator = np.random.default_rng(2)
    poses = torch.stack([translation(float(x), 0.0, 0.4 + float(hill(x))) for x in np.linspace(0, 120, 60)])
    xy = generator.uniform([-25, -25], [145, 25], (120_000, 2))
    z = hill(xy[:, 0]) + 0.06 * np.abs(xy[:, 1]).clip(6, 20) + generator.normal(0, 0.01, len(xy))  # its sides rise, too
    cars = np.concatenate([generator.uniform([x, 4, 0.6], [x + 4, 5.8, 1.6], (1500, 3)) + [0, 0, hill(x + 2)] for x in (20, 50, 90)])
    houses = np.concatenate(
        [generator.uniform([x, s, 0], [x + 12, s + 0.3, 7], (8000, 3)) + [0, 0, hill(x)] for x in (10, 70) for s in (-22, 22)]
    )
    ground = estimate_ground(np.concatenate([np.column_stack([xy, z]), cars, houses]), Trajectory(torch.arange(60) * 100_000, poses))
    for x in (-20, 3, 22, 52, 60, 92, 118, 140):
        for y in (-18, -5, 0, 5, 18):
            true = hill(x) + 0.06 * np.clip(abs(y), 6, 20)
            assert abs(float(ground.height(torch.tensor([float(x), float(y)]))) - true) < 0.2, (x, y)


def test_a_steep_street_is_as_even_as_a_flat_one():
    """It rises by a decimetre from cell to cell: taken at the cells' middles it would lie in steps."""
    generator = np.random.default_rng(7)
    poses = torch.stack([translation(float(x), 0.3 * float(x), 0.4 + 0.2 * float(x)) for x in np.linspace(0, 40, 60)])
    xy = generator.uniform([-25, -20], [65, 40], (400_000, 2))
    points = np.column_stack([xy, 0.2 * xy[:, 0] + generator.normal(0, 0.01, len(xy))])
    ground = estimate_ground(points, Trajectory(torch.arange(60) * 100_000, poses))
    at = torch.from_numpy(generator.uniform([-20, -15], [60, 35], (2000, 2)))
    off = ground.height(at) - 0.2 * at[:, 0]
    assert float(off.std()) < 0.006
    assert float(off.abs().max()) < 0.03


def test_a_car_that_stands_still_has_a_ground():
    points = street_points(np.random.default_rng(3))
    still = Trajectory(torch.arange(5) * 100_000, torch.stack([translation(3.0, 1.0, 0.5)] * 5))
    ground = estimate_ground(points, still)
    assert abs(float(ground.height(torch.tensor([10.0, 4.0]))) - 0.2) < 0.1


def test_a_drive_across_kilometres_takes_larger_cells():
    away = torch.arange(200, dtype=torch.float64) * 15
    poses = torch.eye(4, dtype=torch.float64).repeat(200, 1, 1)
    poses[:, 0, 3] = poses[:, 1, 3] = away
    poses[:, 2, 3] = 0.02 * away
    ground = estimate_ground(np.zeros((0, 3)), Trajectory(torch.arange(200) * 1_000_000, poses))
    assert ground.heights.numel() < 1.05 * MOST and ground.cell > 1
    assert (ground.height(poses[:, :2, 3]) - poses[:, 2, 3]).abs().max() < 0.2
