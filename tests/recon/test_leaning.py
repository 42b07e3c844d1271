from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.log import LidarPoints, Log, Sweep, Track
from recon.objects.actors import inside
from recon.objects.leaning import leaning
from recon.objects.tracks import upright
from scenes.poses import inverse, translation
from scenes.trajectory import Trajectory

SLOPE, LENGTH, HEIGHT = 0.15, 4.6, 1.5


def street(slope: float) -> tuple[Log, torch.Tensor]:
    """A street that climbs, a car that drives up there, in an upright box around all of it, and where that really is, `[T, 4, 4]`."""
    generator = np.random.default_rng(0)
    xy = generator.uniform([-20, -8], [60, 8], (100_000, 2))
    points = np.column_stack([xy, slope * xy[:, 0] + generator.normal(0, 0.01, len(xy))])
    times = np.arange(20) * 100_000
    stamps = np.zeros(len(points) // 10, np.int64)
    sweeps = tuple(Sweep(i, 100_000 * i, lambda i=i: LidarPoints(points[i::10], stamps, stamps)) for i in range(10))
    ego = Trajectory(torch.from_numpy(times), torch.stack([translation(float(x), 0.0, slope * float(x)) for x in np.linspace(0, 30, 20)]))
    x = np.linspace(10, 40, 20)
    true = translation(0.0, 3.0, 0.0).repeat(20, 1, 1)
    up = torch.tensor([-slope, 0.0, 1.0], dtype=torch.float64) / np.hypot(slope, 1)
    true[:, :3, 0], true[:, :3, 2] = torch.tensor([1.0, 0.0, slope], dtype=torch.float64) / np.hypot(slope, 1), up
    true[:, 0, 3], true[:, 2, 3] = torch.from_numpy(x), torch.from_numpy(slope * x)
    middles = (true[:, :3, 3] + HEIGHT / 2 * up).numpy()
    around = np.array([LENGTH, 1.8, HEIGHT + LENGTH * slope])
    box = Track("veh_1", "car", True, around, times, upright(middles - [0, 0, around[2] / 2], np.zeros(20)), np.zeros(20, np.int64), ("a",))
    return Log("hill", None, {}, sweeps, (box,), ego, {}), true


def test_a_box_on_a_hill_leans_as_the_road_does_and_holds_none_of_it():
    log, true = street(SLOPE)
    (box,) = leaning(log, log.sweeps).tracks
    assert float((box.world_from_box - true).abs().max()) < 0.03
    assert box.size[2] == pytest.approx(HEIGHT + LENGTH * SLOPE / 2, abs=0.05), "cut off below alone: above is air"
    road = log.sweeps[0].read().xyz
    local = road @ inverse(box.world_from_box[9])[:3, :3].T.numpy() + inverse(box.world_from_box[9])[:3, 3].numpy()
    assert not inside(local, box.size, 0.15, below=-0.08).any()


@pytest.mark.parametrize("label, slope, tilted", [("pedestrian", SLOPE, 0.0), ("car", 0.02, 0.0), ("car", SLOPE, 0.1)])
def test_who_walks_stands_upright_and_so_does_a_car_on_an_even_street_and_a_log_may_know_better(label: str, slope: float, tilted: float):
    log, _ = street(slope)
    poses = log.tracks[0].world_from_box.clone()
    poses[:, :3, :3] = torch.tensor([[1, 0, -tilted], [0, 1, 0], [tilted, 0, 1]], dtype=torch.float64) / np.hypot(1, tilted)
    log = replace(log, tracks=(replace(log.tracks[0], label=label, world_from_box=poses),))
    assert leaning(log, log.sweeps).tracks[0] is log.tracks[0]


def test_of_a_road_that_nobody_saw_it_is_not_known_how_it_lies():
    log, _ = street(SLOPE)
    far = replace(log.tracks[0], world_from_box=translation(0.0, 40.0, 0.0) @ log.tracks[0].world_from_box)
    assert leaning(replace(log, tracks=(far,)), log.sweeps).tracks[0] is far
    assert leaning(log, ()) is log
