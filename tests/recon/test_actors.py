from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from made_drive import ABSENT, SCANNED_US

from recon import open_log
from recon.log import LidarPoints, Log, Sweep, Track
from recon.objects.actors import Split, _placed, _retimed, inside, split_points
from scenes.poses import translation, yaw
from scenes.trajectory import Trajectory


@pytest.fixture(scope="module")
def split(drive):
    log = open_log(drive)
    return log, split_points(log, list(log.sweeps), [t for t in log.tracks if t.moving])


def test_points_of_a_mover_are_its_own_and_not_static(split, street):
    log, sorted_points = split
    (name,) = sorted_points.actors
    local, sweep = sorted_points.actors[name]
    size = street.actors[0].asset.size.numpy()
    assert inside(local, size, 0.16).all() and set(sweep) == set(range(8)) - {ABSENT}
    # in the box frame all sweeps show the same body
    per_sweep = [local[sweep == s] for s in sorted(set(sweep))]
    assert all(np.abs(p.max(0) - per_sweep[0].max(0)).max() < 0.02 for p in per_sweep)
    track = sorted_points.tracks[0]
    for s in log.sweeps:
        pose = track.world_from_box[list(sorted(set(range(8)))).index(s.index)].numpy()
        static = sorted_points.static[sorted_points.static_sweep == s.index]
        back = np.linalg.inv(pose)
        assert not (inside(static @ back[:3, :3].T + back[:3, 3], size, 0.1, below=-0.1)).any()


def test_a_box_is_dated_by_when_the_lidar_passed_over_it(split):
    log, sorted_points = split
    recorded = next(t for t in log.tracks if t.moving)
    offset = sorted_points.tracks[0].times_us - recorded.times_us
    assert np.abs(offset - SCANNED_US).max() <= 1


def test_no_sweeps_leave_no_points(split):
    log, _ = split
    empty = split_points(log, [], list(log.tracks))
    assert empty.static.shape == (0, 3) and empty.actors == {}


def every_other(track: Track) -> Track:
    """Its boxes of every second sweep, as where only some sweeps are annotated."""
    kept = slice(None, None, 2)
    poses = track.world_from_box[kept]
    return replace(track, times_us=track.times_us[kept], world_from_box=poses, sensor=track.sensor[kept])


def test_between_annotated_sweeps_a_mover_is_where_it_must_have_been(split):
    log, whole = split
    mover = next(t for t in log.tracks if t.moving)
    thinned = split_points(log, list(log.sweeps), [every_other(mover)])
    first, last = mover.times_us[[2, 6]]  # the made-up lidar finds the mover in the first sweep where it is not yet
    for k in (s.index for s in log.sweeps if first <= s.time_us <= last):
        same, wanted = (s.actors[mover.name][0][s.actors[mover.name][1] == k] for s in (thinned, whole))
        assert len(same) == len(wanted) and np.abs(same.max(0) - wanted.max(0)).max() < 0.05
        assert (thinned.static_sweep == k).sum() == (whole.static_sweep == k).sum()


def test_boxes_of_moments_between_sweeps_find_their_points(split, street):
    log, whole = split
    mover, path = next(t for t in log.tracks if t.moving), street.actors[0].trajectory
    times = np.arange(int(mover.times_us[0]), int(mover.times_us[-1]), 30_000) + 7
    home = mover.world_from_box[2] @ torch.linalg.inv(path.near(int(mover.times_us[2]) + SCANNED_US))
    poses = home @ torch.stack([path.near(int(t)) for t in times])
    dated = replace(mover, times_us=times, world_from_box=poses, sensor=np.full(len(times), -1))
    found = split_points(log, list(log.sweeps), [dated])
    assert np.array_equal(found.tracks[0].times_us, times)
    for k in (s.index for s in log.sweeps if times[0] < s.time_us < times[-1]):
        same, wanted = (s.actors[mover.name][0][s.actors[mover.name][1] == k] for s in (found, whole))
        assert len(same) == len(wanted) and np.abs(same.max(0) - wanted.max(0)).max() < 0.08


def test_sweeps_may_be_stamped_when_they_end(split):
    """NCore's are, and its boxes are of the moments at which the lidar passed over them: the last stamp is after the last box."""
    log, whole = split
    mover = next(t for t in log.tracks if t.moving)
    dated = replace(mover, times_us=mover.times_us + SCANNED_US)
    found = split_points(log, [replace(s, time_us=s.time_us + 50_000) for s in log.sweeps], [dated])
    for k in (s.index for s in log.sweeps):
        same, wanted = (s.actors[mover.name][0][s.actors[mover.name][1] == k] for s in (found, whole))
        assert len(same) == len(wanted) and (found.static_sweep == k).sum() == (whole.static_sweep == k).sum()


def test_boxes_far_apart_in_time_tell_nothing_between_them(split):
    log, _ = split
    mover = next(t for t in log.tracks if t.moving)
    ends = [0, len(mover.times_us) - 1]
    rare = replace(mover, times_us=mover.times_us[ends] * [1, 2], world_from_box=mover.world_from_box[ends], sensor=mover.sensor[ends])
    moment = int(mover.times_us[1]) + 50_000
    assert _placed(mover, moment) and not _placed(rare, moment)
    first, last = mover.trajectory().span_us()
    assert _placed(mover, first) and not _placed(mover, first - 1) and not _placed(mover, last + 1)
    assert not _placed(rare, int(rare.times_us[0]))


def test_a_mover_drives_on_beyond_its_ends_as_far_as_it_is_drawn(split):
    """Of nuScenes' sweeps one in ten is annotated: those shortly before and after its boxes would leave it on the road, standing."""
    log, whole = split
    mover = next(t for t in log.tracks if t.moving)
    kept = [2, 5]
    few = replace(mover, times_us=mover.times_us[kept], world_from_box=mover.world_from_box[kept], sensor=mover.sensor[kept])
    found = split_points(log, list(log.sweeps), [few])
    for k in (1, 6):
        same, wanted = (s.actors[mover.name][0][s.actors[mover.name][1] == k] for s in (found, whole))
        assert len(same) == len(wanted) and np.abs(same.max(0) - wanted.max(0)).max() < 0.05
        assert (found.static_sweep == k).sum() == (whole.static_sweep == k).sum()


def test_a_date_is_smoothed_by_those_of_neighbours_in_time(split):
    """Where boxes are half a second apart, the lidar comes by at another phase of its turn each time."""
    mover = next(t for t in split[0].tracks if t.moving)
    late = np.array([-10_000, -20_000, -45_000, -30_000, -40_000, -40_000, -40_000, -40_000])
    often, rare = (replace(mover, times_us=step * np.arange(8)) for step in (100_000, 500_000))
    assert (_retimed(rare, rare.times_us + late, 0.0)[1] == rare.times_us + late).all()
    assert (_retimed(often, often.times_us + late, 0.0)[1] - often.times_us)[2] == -30_000


def test_a_track_without_points_is_scanned_as_late_as_others_are(split):
    track = next(t for t in split[0].tracks if t.moving)
    later, times = _retimed(track, track.times_us.astype(np.float64), 30_000.0)
    assert (times == track.times_us + 30_000).all() and (later.times_us == times).all()


def test_boxes_scanned_out_of_turn_are_left_out(split):
    """However late one was, those that follow it come later than it, too."""
    mover = next(t for t in split[0].tracks if t.moving)
    track = replace(mover, times_us=500_000 * np.arange(8))  # apart enough not to be smoothed
    kept, _ = _retimed(track, track.times_us + np.array([0, 0, 1_200_000, 0, 0, 0, 0, 0]) - 10_000, 0.0)
    assert (np.diff(kept.times_us) > 0).all() and len(kept.times_us) == len(kept.world_from_box) == 6


def test_what_moves_is_where_it_is_at_a_moment():
    poses = torch.stack([translation(10.0 * i, 0.0, 0.0) @ yaw(0.5 * np.pi * i) for i in range(2)])
    track = Track("veh_1", "car", True, np.array([4.0, 2.0, 1.6]), np.array([0, 700_000]), poses, np.zeros(2), ())
    local, of = np.array([[1.0, 0.0, 0.5], [2.0, 0.0, 0.5]]), np.array([4, 7])
    split = Split(np.zeros((0, 3)), np.zeros(0, np.int64), {"veh_1": (local, of)}, (track,))
    np.testing.assert_allclose(split.moved(4, 0), [[1, 0, 0.5]], atol=1e-9)
    np.testing.assert_allclose(split.moved(7, 700_000), [[10, 2, 0.5]], atol=1e-9)
    assert split.moved(5, 0).shape == split.moved(4, 5_000_000).shape == (0, 3)


def test_points_of_a_second_lidar_are_where_the_car_was_when_it_passed_over_it():
    speed, late = 15.0, {0: -30_000, 1: 15_000}
    stamps = np.arange(6) * 100_000
    size = np.array([4.0, 2.0, 1.5])
    poses = torch.stack([translation(speed * (t + late[0]) / 1e6, 0.02 * i, 0.0) for i, t in enumerate(stamps)])
    track = Track("veh_1", "car", True, size, stamps, poses, np.zeros(len(stamps)), ())
    rear = np.stack(np.meshgrid([-2.0], np.linspace(-0.9, 0.9, 9), np.linspace(0.3, 1.4, 9), indexing="ij"), -1).reshape(-1, 3)
    wall = rear + [0.0, 4.0, 0.0]

    def read(i: int, stamp: int) -> LidarPoints:
        parts = [rear + [speed * (stamp + moment) / 1e6, 0.02 * (i + (moment - late[0]) / 1e5), 0.0] for moment in late.values()]
        sensor = np.repeat([0, 1, 0], len(rear))
        times = stamp + np.where(sensor == 0, late[0], late[1])
        return LidarPoints(np.concatenate([*parts, wall]), times, sensor)

    sweeps = tuple(Sweep(i, int(t), partial(read, i, int(t))) for i, t in enumerate(stamps))
    log = Log("two", Path("two"), {}, sweeps, (track,), Trajectory(track.times_us, poses), {}, ())
    sorted_points = split_points(log, sweeps, [track])
    local, sweep = sorted_points.actors["veh_1"]
    assert (np.bincount(sweep) == 2 * len(rear)).all() and np.abs(local - np.tile(rear, (12, 1))).max() < 1e-6
    assert len(sorted_points.static) == len(wall) * len(sweeps)


@pytest.mark.parametrize("offsets", [[-49, 49] * 4, [20 * i - 50 for i in range(6)], [30, -40, 35, 32, 33, 31]])
def test_a_box_is_the_measure_of_its_own_points_whenever_the_lidar_passed_over_it(offsets):
    speed, stamps, late = 15.0, np.arange(len(offsets)) * 100_000, np.array(offsets) * 1000
    size = np.array([4.0, 2.0, 1.5])
    poses = torch.stack([translation(speed * t / 1e6, 0.0, 0.0) for t in stamps + late])
    track = Track("veh_1", "car", True, size, stamps, poses, np.full(len(stamps), -1), ())
    skin = np.stack(np.meshgrid([-2.0, 2.0], np.linspace(-0.9, 0.9, 9), np.linspace(0.3, 1.4, 9), indexing="ij"), -1).reshape(-1, 3)

    def read(i: int) -> LidarPoints:
        times = np.full(len(skin), stamps[i] + late[i])
        return LidarPoints(skin + poses[i, :3, 3].numpy(), times, np.zeros(len(skin), np.int64))

    sweeps = tuple(Sweep(i, int(t), partial(read, i)) for i, t in enumerate(stamps))
    log = Log("one", Path("one"), {}, sweeps, (track,), Trajectory(track.times_us, poses), {}, ())
    sorted_points = split_points(log, sweeps, [track])
    local, _ = sorted_points.actors["veh_1"]
    assert len(sorted_points.static) == 0 and np.abs(local - np.tile(skin, (len(offsets), 1))).max() < 1e-6
