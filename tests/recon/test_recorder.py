import numpy as np
import pytest
import torch

from recon import open_log
from recon.log import LidarPoints, Log, Sweep, Track
from recon.readers.recorder import without_recorder
from scenes import Trajectory
from scenes.poses import translation, yaw

REAR_AXLE = [
    [0.94, 0.0, 1.84],  # the lidar's own housing, at no distance
    [2.7, 0.4, 1.0],  # the bonnet
    [-0.9, -0.8, 0.9],  # the boot
    [4.6, 0.0, 0.0],  # the road ahead
    [0.9, 1.5, 0.5],  # a door beside
    [-2.4, 0.0, 0.7],  # a car behind
]


ROOF, BUMPERS = {0: np.array([0.94, 0.0, 1.84])}, {1: np.array([-1.1, 0.0, 0.7]), 2: np.array([3.9, 0.3, 0.7])}


@pytest.mark.parametrize("lidars", [ROOF, ROOF | BUMPERS, ROOF | {2: BUMPERS[2]}])
def test_points_on_the_recording_car_are_no_street(lidars):
    pose = translation(30.0, -4.0, 0.5) @ yaw(2.1)
    ego = Trajectory(torch.tensor([0, 100_000]), torch.stack([pose @ translation(-1.0, 0, 0), pose]))
    xyz = np.array(REAR_AXLE) @ pose[:3, :3].numpy().T + pose[:3, 3].numpy()
    points = LidarPoints(xyz, 100_000 + np.arange(6), np.arange(6) % 2)
    log = Log("street", "street", {}, (Sweep(3, 100_000, lambda: points),), (), ego, {}, lidars=lidars)
    (sweep,) = without_recorder(log).sweeps
    left = sweep.read()
    assert (sweep.index, sweep.time_us) == (3, 100_000)
    np.testing.assert_array_equal(left.xyz, xyz[3:])
    assert left.times_us.tolist() == [100_003, 100_004, 100_005] and left.sensor.tolist() == [1, 0, 1]


def test_a_log_opens_without_them(drive):
    log = open_log(drive)
    for sweep in log.sweeps:
        local = sweep.read().xyz - log.ego.at(sweep.time_us)[:3, 3].numpy()
        assert len(local) and np.linalg.norm(local[:, :2], axis=1).min() > 1


def test_its_points_stand_where_it_was_when_each_was_taken():
    """At 20 m/s, two metres a turn: against the stamp's place alone, half of the bonnet would be street."""
    ego = Trajectory(torch.tensor([0, 200_000]), torch.stack([translation(0.0, 0, 0), translation(4.0, 0, 0)]))
    times = np.linspace(0, 100_000, 60).astype(np.int64)
    bonnet = np.stack([3.3 + 20e-6 * times, np.full(60, 0.3), np.full(60, 0.9)], 1)
    log = Log("street", "street", {}, (Sweep(0, 100_000, lambda: LidarPoints(bonnet, times, 0 * times)),), (), ego, {}, lidars=ROOF)
    assert len(without_recorder(log).sweeps[0].read().xyz) == 0


def test_a_box_around_the_recording_car_is_left_out(capsys):
    """Cameras stand in it: all that they see would lie behind its nearest corner."""
    times = np.arange(4) * 100_000
    poses = torch.stack([translation(2.0 * i, 0, 0) @ yaw(0.3) for i in range(4)])
    ego = Trajectory(torch.from_numpy(times), poses @ translation(0.5, 0.1, 1.8))

    def box(name, place):
        return Track(name, "car", True, np.array([4.8, 2.0, 1.6]), times, place, np.full(4, -1), (name,))

    ahead = poses @ translation(6.0, 0, 0)
    brushes = torch.cat([poses[:1], ahead[1:]])
    log = Log("street", "street", {}, (), (box("own", poses), box("ahead", ahead), box("brushes", brushes)), ego, {})
    assert [t.name for t in without_recorder(log).tracks] == ["ahead", "brushes"]
    assert "box own stands around the recording car" in capsys.readouterr().err


def test_a_robot_is_smaller_than_a_car():
    """Its lidar stands 0.45 m above the floor of a corridor, whose walls a car's box would hold; its own mast is left out all the same."""
    floor = np.random.default_rng(0).uniform([1.5, -0.7, -0.46], [4.0, 0.7, -0.44], (300, 3))
    mast, walls = [0.2, 0.1, 0.05], [[0.5, 0.75, 0.2], [1.0, -0.75, 0.3]]
    xyz = np.concatenate([floor, [mast], walls])
    points = LidarPoints(xyz, np.zeros(len(xyz), np.int64), np.zeros(len(xyz), np.int64))
    ego = Trajectory(torch.tensor([0, 100_000]), torch.stack([translation(0.0, 0, 0), translation(0.05, 0, 0)]))
    log = Log("corridor", "corridor", {}, (Sweep(0, 0, lambda: points),), (), ego, {})
    left = without_recorder(log).sweeps[0].read().xyz
    np.testing.assert_array_equal(left, np.concatenate([floor, walls]))
