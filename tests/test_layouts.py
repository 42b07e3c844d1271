"""What the layouts' writers put on disk reads back as it was, and made-up lidars see what is there."""

from pathlib import Path

import numpy as np
import pytest
import torch
from made_drive import write_drive
from scipy.spatial import cKDTree

from recon import open_log
from recon.log import LidarPoints, Log, Sweep, Track, mean_pose
from recon.objects.actors import box_skin
from recon.readers.recorder import without_recorder
from recon.registration.corrected import moved
from scenes.poses import inverse, translation
from scenes.trajectory import Trajectory
from tests.bench.layouts import LAYOUTS, part_of, recorded
from tests.layouts import carried
from tests.layouts.lidar import Spinner, Street, boxes, sweep

CAMERA = "front_camera"
OPTIONAL = {"argoverse2": "pyarrow", "waymo": "pyarrow"}


@pytest.fixture(scope="module")
def part(street, tmp_path_factory) -> Log:
    """All of the made-up drive but its first and last frame, beyond which its path is not known."""
    return part_of(open_log(write_drive(tmp_path_factory.mktemp("made") / "drive", street)), CAMERA, range(1, 7))


@pytest.mark.parametrize("name", LAYOUTS)
def test_what_is_written_reads_back_as_it_was(part, name, tmp_path):
    if name in OPTIONAL:
        pytest.importorskip(OPTIONAL[name], reason="needs pyarrow: pip install 'sidestep[arrow]'")
    layout = LAYOUTS[name]
    written = recorded(part, Street.of(part, part.sweeps), CAMERA, layout)
    layout.write(tmp_path / name, written)
    read = open_log(tmp_path / name / layout.opens)
    camera, same = read.camera(read.front[0]), written.camera("front")
    assert camera.times_us.tolist() == same.times_us.tolist() and (camera.width, camera.height) == (same.width, same.height)
    assert (camera.shutter, camera.readout_us) == ((same.shutter, same.readout_us) if name == "waymo" else ("global", 0))
    assert [camera.files[i].read_bytes() if name != "waymo" else camera.files[i].read() for i in range(len(camera))] == [
        file.read_bytes() for file in same.files
    ], "pictures are copied as they are"
    np.testing.assert_allclose(camera.lens.params()[:4], same.lens.params(), atol=1e-5)
    torch.testing.assert_close(mean_pose(read.offsets(camera.name)), mean_pose(written.offsets("front")), atol=1e-3, rtol=0)

    # from one world into the other where the car is, since no height is told in nuScenes'
    stamps = torch.tensor([s.time_us for s in written.sweeps])
    home = written.ego.near_each(stamps) @ inverse(read.ego.near_each(stamps))
    one = home[:1].expand_as(home) if name != "nuscenes" else home
    assert (home[:, :2, 3] - one[:, :2, 3]).abs().max() < 1e-3 and (home - one).abs().max() < 1e-3
    there = moved(read, Trajectory(stamps, home))
    assert [s.time_us for s in there.sweeps] == stamps.tolist()
    for got, wanted in zip((s.read() for s in there.sweeps), (s.read() for s in without_recorder(written).sweeps), strict=True):
        assert len(got.xyz) == len(wanted.xyz) > 50
        off, which = cKDTree(wanted.xyz).query(got.xyz)
        assert off.max() < 2e-3
        # told by places on the path, or by directions from where the lidar was as the sweep ended: 0.2 m off, 1 m from what it sees
        assert np.abs(got.times_us - wanted.times_us[which]).max() < {"waymo": 3000, "nuscenes": 4000}.get(name, 10)
        assert set(got.sensor.tolist()) == ({0, 1} if name == "argoverse2" else {1} if name == "waymo" else {0})
    assert len(there.tracks) == len(written.tracks) == 2
    for ours, theirs in zip(*(sorted(log.tracks, key=lambda t: t.moving) for log in (there, written)), strict=True):
        assert (ours.label, ours.times_us.tolist()) == (theirs.label, theirs.times_us.tolist())
        assert ours.moving == theirs.moving
        np.testing.assert_allclose(ours.size, theirs.size, atol=1e-5)
        torch.testing.assert_close(ours.world_from_box, theirs.world_from_box, atol=2e-3, rtol=0)


AHEAD = Spinner((0.0, 0.0, 2.0), np.radians(np.linspace(-10, 10, 21)), 360, 100_000, True, 80.0)


def standing(static: np.ndarray, movers: dict | None = None, tracks: tuple[Track, ...] = ()) -> LidarPoints:
    """A turn of the lidar on a car that goes along x at 10 m/s, at 0 as the turn begins."""
    times = torch.tensor([0, 100_000])
    ego = Trajectory(times, torch.stack([translation(0.0, 0.0, 0.0), translation(1.0, 0.0, 0.0)]))
    return sweep(Street(static, movers or {}, tracks), AHEAD, ego, 0)


def test_a_beam_shows_the_middle_of_a_noisy_wall_and_nothing_behind_it():
    noise = np.random.default_rng(0)
    wall, behind = (np.stack([np.full(40_000, x), *noise.uniform(-4, 4, (2, 40_000))], 1) for x in (20.0, 30.0))
    wall[:, 0] += noise.normal(0, 0.05, len(wall))
    found = standing(np.concatenate([behind, wall]))
    assert 150 < len(found.xyz) < 21 * 23 and np.abs(found.xyz[:, 0] - 20).max() < 0.2
    assert abs(float(np.median(found.xyz[:, 0])) - 20) < 0.01 < 20 - np.median([wall[_near(wall, p), 0].min() for p in found.xyz])
    assert np.abs(found.times_us - 50_000).max() < 100_000 * 15 / 360, "it looks ahead in the middle of its turn"


def _near(wall: np.ndarray, point: np.ndarray) -> np.ndarray:
    return np.linalg.norm(wall[:, 1:] - point[1:], axis=1) < 0.17


def test_a_mover_is_seen_where_it_was_when_the_lidar_looked_there():
    size = np.array([4.0, 2.0, 1.5])
    times = np.array([-100_000, 0, 100_000, 200_000])
    poses = torch.stack([translation(10.0 - 15 * t / 1e6, 8.0, 0.0) for t in times.tolist()])
    track = Track("veh_1", "car", True, size, times, poses, np.full(4, -1), ("a",))
    own = box_skin(size, 0.1)
    found = standing(np.zeros((0, 3)), {"veh_1": own}, (track,))
    assert len(found.xyz) > 30
    back = inverse(track.trajectory().near_each(torch.from_numpy(found.times_us)))
    assert cKDTree(own).query(carried(found.xyz, back))[0].max() < 1e-3
    # clockwise from behind, what is 8 m to the left and ahead comes before the middle; its box is drawn by the same moment
    assert found.times_us.min() > 20_000 and found.times_us.max() < 45_000
    ego = Trajectory(torch.tensor([0, 100_000]), torch.stack([translation(0.0, 0.0, 0.0), translation(1.0, 0.0, 0.0)]))
    (drawn,) = boxes(Street(np.zeros((0, 3)), {"veh_1": own}, (track,)), AHEAD, ego, [0], [777])
    assert drawn.times_us.tolist() == [777]
    looked = (10.0 - float(drawn.world_from_box[0, 0, 3])) / 15 * 1e6
    assert found.times_us.min() < looked < found.times_us.max()


def test_dust_of_one_sweep_is_no_street():
    noise = np.random.default_rng(0)
    ego = Trajectory(torch.tensor([0, 600_000]), torch.stack([translation(), translation(6.0, 0.0, 0.0)]))

    def swept(i: int) -> Sweep:
        wall = np.stack([noise.uniform(-4, 4, 500), np.full(500, 5.0), noise.uniform(0, 3, 500)], 1)
        xyz = np.concatenate([wall, np.full((int(i == 2), 3), 10.0)])
        points = LidarPoints(xyz, np.full(len(xyz), i * 100_000), np.zeros(len(xyz), np.int64))
        return Sweep(i, i * 100_000, lambda: points)

    log = Log("dust", Path("dust"), {}, tuple(map(swept, range(7))), (), ego, {})
    static = Street.of(log, log.sweeps).static
    assert len(static) > 3000 and np.abs(static[:, 1] - 5.0).max() == 0
