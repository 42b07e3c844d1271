from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_sweeps import MOUNT, Box, drive, standing

from recon.log import LidarPoints, Sweep, Track
from recon.movers.boxing import _fitted, boxed, headings, smoothed
from recon.movers.following import Cluster, Followed, Patience
from recon.movers.freespace import OFFSETS, range_image, tally
from recon.movers.search import _read, clusters, with_movers
from recon.ready import annotated
from scenes.ground import Ground
from scenes.poses import translation, yaw
from scenes.trajectory import Trajectory

CAR = (4.4, 1.8, 1.5)
WALLS = [standing(20, side * 14, (140, 1, 8)) for side in (-1, 1)]
PARKED = [standing(x, side * 5.5) for x in (-12, -4, 6, 13, 24, 33, 45) for side in (-1, 1)]
STREET = [*WALLS, *PARKED, *(standing(x, 8.5, (0.3, 0.3, 6.0)) for x in (0, 15, 30, 45))]


def braking(seconds: float) -> tuple[float, float, float]:
    """15 metres ahead at 8 m/s; from 1.5 s on it brakes by 4 m/s2 and stands."""
    t = min(max(seconds - 1.5, 0.0), 2.0)
    return 15 + 8 * min(seconds, 1.5) + 8 * t - 2 * t * t, 0.0, 0.0


def turning(seconds: float) -> tuple[float, float, float]:
    """A quarter of a circle of 10 metres at 5 m/s, to the left."""
    turned = 0.5 * seconds
    return 20 + 10 * np.sin(turned), -2 + 10 * (1 - np.cos(turned)), turned


MOVING = {
    "ahead": Box(CAR, lambda t: (14 + 9 * t, 0.0, 0.0)),
    "oncoming": Box(CAR, lambda t: (45 - 9 * t, 3.0, np.pi)),
    "bus": Box((11.0, 2.5, 3.0), lambda t: (-14 + 13 * t, -2.8, 0.0)),
    "turns": Box(CAR, turning),
    "walks": Box((0.6, 0.7, 1.75), lambda t: (18.0, 6.0 - 1.6 * t, -np.pi / 2)),
    "pedals": Box((1.8, 0.7, 1.8), lambda t: (8 + 5 * t, -3.5, 0.0)),
}


def found(*boxes: Box, **how) -> tuple[Track, ...]:
    log = drive([*STREET, *boxes], **how)
    return with_movers(log, log.sweeps).tracks


def misses(track: Track, box: Box) -> tuple[np.ndarray, np.ndarray]:
    """Metres `[T]` between the middles, and radians between the headings, at the moments at which the lidar looked at the box."""
    off, turned = [], []
    for stamp, pose in zip(track.times_us.tolist(), track.world_from_box.numpy(), strict=True):
        x, y, _ = box.at(stamp / 1e6)
        eye = np.array([8.0 * stamp / 1e6, 0]) + MOUNT[:2]
        # the lidar looks ahead at its stamp, and elsewhere before or after
        x, y, yaw = box.at(stamp / 1e6 + 0.1 * np.arctan2(y - eye[1], x - eye[0]) / (2 * np.pi))
        off.append(np.linalg.norm(pose[:2, 3] - [x, y]))
        turned.append(np.abs((np.arctan2(pose[1, 0], pose[0, 0]) - yaw + np.pi) % (2 * np.pi) - np.pi))
    return np.array(off), np.array(turned)


@pytest.mark.parametrize("name", MOVING)
def test_what_moves_is_found_once_where_it_is(name):
    box = MOVING[name]
    tracks = found(box)
    assert len(tracks) == 1
    off, turned = misses(tracks[0], box)
    assert tracks[0].moving and np.median(off) < 0.2 and np.quantile(off, 0.9) < 0.5 and np.median(turned) < 0.05
    assert abs(tracks[0].size - box.size).max() < 0.7  # of the bus, the roof is above what the lidar sees
    kinds = {"bus": "truck", "walks": "pedestrian", "pedals": "cyclist"}
    assert tracks[0].label == kinds.get(name, "car")


def test_several_at_once_are_told_apart():
    boxes = [MOVING[name] for name in ("ahead", "oncoming", "walks", "bus")]
    tracks = found(*boxes)
    assert len(tracks) == 4
    for box in boxes:
        assert min(np.median(misses(t, box)[0]) for t in tracks) < 0.4


@pytest.mark.parametrize("speed", [0.0, 12.0])
def test_nothing_is_found_where_nothing_moves(speed):
    """Though everything moves past the car, and hides and shows what is behind."""
    assert found(speed=speed) == ()


def test_the_recording_cars_own_bonnet_is_no_mover():
    """It goes wherever the car goes, and others see through where it was."""
    assert found(Box((1.3, 1.6, 1.1), lambda t: (8 * t + 3.4, 0.0, 0.0))) == ()


def test_a_car_that_waits_before_it_goes_is_followed_as_it_goes():
    """While it waits, one moment shows its rear, another its side: it is known less well."""
    box = Box(CAR, lambda t: (22 + 2 * max(t - 1.5, 0) ** 2, -2.5, 0.0))
    (track,) = found(box)
    off, turned = misses(track, box)
    assert off[-10:].max() < 0.3 and turned[-10:].max() < 0.2 and np.median(off) < 1.0


def test_a_car_that_stops_ahead_is_followed_to_the_end():
    """Where it stands, nobody ever sees through: it is known by its shape."""
    (track,) = found(Box(CAR, braking), count=60, speed=2.0)
    assert track.times_us[-1] == 59 * 100_000
    x, y, _ = braking(5.9)
    assert np.linalg.norm(track.world_from_box[-1, :2, 3].numpy() - [x, y]) < 0.4


def test_sparse_sweeps_are_enough():
    (track,) = found(MOVING["oncoming"], rows=16, columns=360)
    assert np.median(misses(track, MOVING["oncoming"])[0]) < 0.6


def test_two_sweeps_a_second_are_enough():
    """As nuScenes' key frames alone are. What stands is still not followed."""
    box = MOVING["ahead"]
    log = drive([*STREET, box], count=50)
    (track,) = with_movers(log, log.sweeps[::5]).tracks
    off = np.linalg.norm(track.world_from_box[:, :2, 3].numpy() - [box.at(t / 1e6)[:2] for t in track.times_us.tolist()], axis=1)
    assert np.median(off) < 0.6


def test_sweeps_without_points_are_left_out():
    log = drive([*STREET, MOVING["oncoming"]])
    empty = LidarPoints(np.zeros((0, 3)), np.zeros(0, np.int64), np.zeros(0, np.int64))
    sweeps = [replace(s, read=lambda: empty) if s.index % 10 == 5 else s for s in log.sweeps]
    (track,) = with_movers(log, sweeps).tracks
    assert np.median(misses(track, MOVING["oncoming"])[0]) < 0.2
    assert with_movers(log, [replace(s, read=lambda: empty) for s in log.sweeps]).tracks == ()


def test_two_lidars_that_turn_at_one_moment_see_one_thing_once():
    log = drive([*STREET, MOVING["oncoming"]])
    first = [replace(s, read=partial(half, s, 0)) for s in log.sweeps]
    second = [replace(s, index=len(first) + s.index, read=partial(half, s, 1)) for s in log.sweeps]
    both = replace(log, sweeps=(*first, *second), lidars={0: MOUNT, 1: MOUNT})
    (track,) = with_movers(both, both.sweeps).tracks
    assert np.median(misses(track, MOVING["oncoming"])[0]) < 0.2 and track.trajectory().covers(1_000_000)


@pytest.mark.parametrize(("through", "there", "moves"), [(2, 6, True), (2, 7, False), (1, 0, False)])
def test_what_most_sweeps_saw_standing_there_did_not_move(through, there, moves):
    """Whatever two of them seem to have seen through: leaves, or a fence."""
    points = np.random.default_rng(0).uniform((10, 0, 0.5), (10.4, 0.4, 1.5), (60, 3))
    votes = [(True, False)] * through + [(False, True)] * there
    images = [(time, SimpleNamespace(cell=0.5, votes=lambda xyz, says=says: [np.full(len(xyz), v) for v in says])) for time, says in
              zip((1_000_000 * t for t in OFFSETS), votes, strict=False)]  # fmt: skip
    assert len(clusters(0, points, images, np.zeros(3))) == moves


def test_sweeps_of_lidars_that_turn_at_other_moments_are_read_by_time():
    def sweep(time_us: int, x: float) -> Sweep:
        return Sweep(0, time_us, lambda: LidarPoints(np.full((2, 3), x), np.full(2, time_us), np.zeros(2, np.int64)))

    read = _read([sweep(0, 1), sweep(200, 2), sweep(100, 3), sweep(200, 4)])
    assert {time: points.xyz[:, 0].tolist() for time, points in read.items()} == {0: [1, 1], 100: [3, 3], 200: [2, 2, 4, 4]}
    assert list(read) == [0, 100, 200] and read[200].times_us.tolist() == 4 * [200]


def half(sweep: Sweep, sensor: int) -> LidarPoints:
    """Every other point, as seen by a lidar of that number."""
    points = sweep.read()
    return LidarPoints(points.xyz[sensor::2], points.times_us[sensor::2], np.full(len(points.xyz[sensor::2]), sensor))


def test_sensors_that_stand_nowhere_known_are_not_asked():
    log = drive([*STREET, MOVING["oncoming"]], count=20)
    assert with_movers(replace(log, lidars={}), log.sweeps).tracks == ()


def test_tracks_stand_at_all_stamps_of_the_log():
    """Also at those of sweeps that were kept from the search: they are measured against."""
    log = drive([*STREET, MOVING["oncoming"]])
    (track,) = with_movers(log, [s for s in log.sweeps if s.index % 8 != 4]).tracks
    stamps = [s.time_us for s in log.sweeps]
    inside = [t for t in stamps if track.times_us[0] <= t <= track.times_us[-1]]
    assert track.times_us.tolist() == inside and len(inside) > 25


def test_a_log_with_boxes_keeps_them(capsys):
    log = drive([*STREET, MOVING["oncoming"]], count=20)
    searched = annotated(log, log.sweeps)
    assert len(searched.tracks) == 1 and searched.meta["movers"] == "found in lidar"
    assert "has no boxes: its lidar shows 1 thing that moves" in capsys.readouterr().err
    assert annotated(searched, log.sweeps).tracks == searched.tracks
    assert annotated(log, ()) is log


def test_votes_tell_free_space_from_what_is_hidden():
    log = drive([standing(20, 0, (1, 30, 6)), standing(10, -6, (1, 4, 6))], count=3, speed=0.0)
    image = range_image(log.sweeps[0].read(), log.ego, MOUNT)
    points = {"free": [15.0, 3, 1.5], "wall": [19.5, 3, 1.5], "behind it": [22.0, 3, 1.5], "behind a box": [15.0, -9.5, 1.5]}
    through, there = (dict(zip(points, v.tolist(), strict=True)) for v in image.votes(np.array(list(points.values()))))
    assert [k for k, v in through.items() if v] == ["free"] and [k for k, v in there.items() if v] == ["wall"]
    others = [(s.time_us, range_image(s.read(), log.ego, MOUNT)) for s in log.sweeps]
    through, there = tally(np.array([[15.0, 3, 1.5], [19.5, 3, 1.5]]), 0, others)
    assert through.tolist() == [1, 0] and there.tolist() == [0, 1]  # the sweep 0.2 s later; its neighbour saw the same


def around(pole: int) -> tuple[LidarPoints, Trajectory]:
    """A wall 20 m around a lidar that stands, a point each two degrees; in one column a pole 5 m away stands before it."""
    azimuth, up = (np.radians(v.ravel()) for v in np.meshgrid(np.arange(-179, 180, 2), np.arange(-9, 10, 2)))
    towards = np.stack([np.cos(up) * np.cos(azimuth), np.cos(up) * np.sin(azimuth), np.sin(up)], 1)
    far = np.where(np.tile(np.arange(180), 10) == pole, 5, 20)
    still = Trajectory(torch.tensor([0, 100_000]), torch.eye(4, dtype=torch.float64).repeat(2, 1, 1))
    return LidarPoints(far[:, None] * towards, np.zeros(1800, np.int64), np.zeros(1800, np.int64)), still


@pytest.mark.parametrize("pole", [90, 0, 179])
def test_beside_a_pole_nobody_saw_through_also_where_azimuths_begin_anew(pole):
    points, still = around(pole)
    image = range_image(points, still, np.zeros(3))
    through, _ = image.votes(0.75 * points.xyz[5 * 180 + (pole + np.array([-2, -1, 1, 2])) % 180])
    assert image.range_m.shape[1] == 180 and through.tolist() == [True, False, False, True]


def test_the_farther_away_the_farther_must_others_have_seen():
    """At 20 m, 0.5 m and a fiftieth of the way."""
    points, still = around(-1)
    through, there = range_image(points, still, np.zeros(3)).votes(points.xyz[900] / 20 * np.array([[18.9], [19.3], [20.8], [21.1]]))
    assert through.tolist() == [True, False, False, False] and there.tolist() == [False, True, True, False]


@pytest.mark.parametrize("turned", [0.0, 2.0])
def test_a_box_reaches_away_from_the_lidar_behind_the_end_that_is_seen(turned):
    """A car of which only the rear was seen, from behind, and only the front, from ahead."""
    turn = yaw(turned).numpy()[:3, :3]
    end = np.stack(np.meshgrid([0.0], np.linspace(-0.9, 0.9, 8), [0.5, 1.0]), -1).reshape(-1, 3) @ turn.T
    for behind in (1, -1):
        size, placed = _fitted([Cluster(end, 0, turn @ [-20.0 * behind, 0.0, 0.0])], np.array([turned]), np.zeros((1, 2)))
        assert size.tolist() == pytest.approx([4.3, 1.8]) and placed[0] == pytest.approx(behind * 2.15 * turn[:2, 0])


def test_what_moved_in_few_of_its_sweeps_is_not_believed():
    places = [Cluster(np.zeros((1, 3)), i, np.zeros(3), moved=i < 6) for i in range(25)]
    thing = Followed(places[0], Patience((0.5, 1.0), 5, 3))
    thing.clusters = places[:24]
    assert thing.believed
    thing.clusters = places
    assert not thing.believed


def test_a_smoothed_way_keeps_what_is_straight_and_leaves_out_what_is_odd():
    times = np.linspace(0, 3, 31)
    way = np.stack([4 * times, 1 - 2 * times], 1)
    np.testing.assert_allclose(smoothed(times, way, times), way, atol=1e-6)
    odd = way.copy()
    odd[15] += [0.0, 3.0]
    assert np.abs(smoothed(times, odd, times) - way).max() < 0.25
    at = np.array([0.05, 1.51])
    np.testing.assert_allclose(smoothed(times, way, at), np.stack([4 * at, 1 - 2 * at], 1), atol=1e-6)


def test_what_stands_faces_where_it_came_from_or_goes():
    way = np.array([[0.0, 0], [0, 1], [0, 2], [0, 3], [0.02, 3], [-0.02, 3.01], [0, 3], [0.01, 2.99]])
    assert np.abs(headings(way, 1.5) - np.pi / 2).max() < 0.02
    assert torch.isfinite(torch.from_numpy(headings(np.zeros((3, 2)), 1.5))).all()


def test_what_drives_towards_where_angles_wrap_faces_ahead_between_its_sweeps():
    """Along -x on a slope, swaying a little; a lidar beside its way sees one of its sides and its front."""
    slope = Ground((0.1 * torch.arange(200.0))[None].expand(100, -1).contiguous(), (-100.0, -50.0), 1.0)
    side = np.stack(np.meshgrid(np.linspace(-2.1, 2.1, 15), [-0.9], np.linspace(0.3, 1.5, 5)), -1).reshape(-1, 3)
    front = np.stack(np.meshgrid([-2.1], np.linspace(-0.9, 0.9, 8), np.linspace(0.3, 1.5, 5)), -1).reshape(-1, 3)
    skin, times = np.concatenate([side, front]), 100_000 * np.arange(15)
    middles = np.stack([20.0 - np.arange(15), 6 + 0.05 * (np.arange(15) % 2)], 1)
    found = []
    for time, middle in zip(times.tolist(), middles, strict=True):
        base = float(slope.height(torch.from_numpy(middle)))
        found.append(Cluster(skin + [*middle, base], time, np.array([-40.0, -30.0, 0.0])))
    track = boxed(found, slope, np.arange(0, 1_400_001, 50_000))
    assert track is not None and track.label == "car" and (track.world_from_box[:, 0, 0] < -0.98).all()
    path = track.trajectory()
    at = np.stack([path.at(int(t))[:2, 3].numpy() for t in times])
    assert np.abs(at - middles).max() < 0.25 and np.abs(track.size[:2] - [4.3, 1.8]).max() < 0.15 and track.size[2] < 2
    heights = slope.height(track.world_from_box[:, :2, 3])
    torch.testing.assert_close(track.world_from_box[:, 2, 3], heights, atol=1e-6, rtol=0)


def test_a_lidar_looks_from_where_it_stands_on_a_car_that_turned():
    """Half a turn, 2 m before the body's middle: a wall in sight, and what stands before and behind it."""
    ego = Trajectory(torch.tensor([0, 100_000]), torch.stack([translation(10.0, 3.0) @ yaw(angle) for angle in (2.0, 2.1)]))
    mount, way = np.array([2.0, 0.0, 1.8]), np.array([np.cos(2.05), np.sin(2.05), 0.0])
    eye = np.array([10.0, 3.0, 1.8]) + 2 * way
    aside, up = (v.ravel() for v in np.meshgrid(np.linspace(-5, 5, 400), np.linspace(-1, 1, 40)))
    wall = eye + 20 * way + aside[:, None] * [-way[1], way[0], 0] + up[:, None] * [0, 0, 1.0]
    times = np.full(len(wall), 50_000)
    times[:2] = 0, 100_000
    image = range_image(LidarPoints(wall, times, np.zeros(len(wall), np.int64)), ego, mount)
    np.testing.assert_allclose(image.middle, eye, atol=1e-6)
    through, there = image.votes(np.stack([eye + far * way for far in (18.5, 20.0, 21.5)]))
    assert through.tolist() == [True, False, False] and there.tolist() == [False, True, False]
