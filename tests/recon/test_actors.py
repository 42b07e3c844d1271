import numpy as np
import pytest
from made_drive import ABSENT, SCANNED_US

from recon import open_log
from recon.actors import inside, split_points


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
    assert np.abs(offset[1:] - SCANNED_US).max() <= 1


def test_no_sweeps_leave_no_points(split):
    log, _ = split
    empty = split_points(log, [], list(log.tracks))
    assert empty.static.shape == (0, 3) and empty.actors == {}
