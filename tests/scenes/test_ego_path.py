import math
from dataclasses import replace

import pytest
import torch
from street import START_US, STEP_US

from scenes import Ground, Trajectory
from scenes.ego_path import CAR, changing_lane, driven
from scenes.lateral import Keyframe, parse_lateral
from scenes.poses import translation, yaw, yaw_of
from scenes.standing import standing_pose

SECOND = 1_000_000
END_US = START_US + 6 * SECOND


def road(poses, step_us=SECOND // 10):
    return Trajectory(START_US + step_us * torch.arange(len(poses)), torch.stack(poses))


def straight(speed=10.0, seconds=6.0, pitch=0.0):
    """A drive along x, tilted by radians nose down, which begins at a corner of the world."""
    tilt = torch.eye(4, dtype=torch.float64)
    tilt[0, 0], tilt[0, 2], tilt[2, 0], tilt[2, 2] = math.cos(pitch), math.sin(pitch), -math.sin(pitch), math.cos(pitch)
    return road([translation(3.0 + speed * i / 10, -2.0, 1.5) @ tilt for i in range(round(10 * seconds) + 1)])


def at(path, seconds):
    return path.at(START_US + round(seconds * SECOND))


def test_a_lane_is_changed_between_two_keyframes():
    ego = straight(pitch=0.02)
    path, notes = changing_lane(ego, parse_lateral("0m@1s,3.5m@4s"), START_US, END_US)
    assert notes == []
    for seconds, left in ((0, 0), (1, 0), (2.5, 1.75), (4, 3.5), (6, 3.5)):
        there = (at(ego, seconds).inverse() @ at(path, seconds))[:3, 3]
        assert there.tolist() == pytest.approx([0, left, 0], abs=1e-6), seconds
    for seconds in (0.5, 1, 4, 5.5):
        assert float(yaw_of(at(path, seconds))) == pytest.approx(0, abs=1e-9)
    assert path.span_us()[0] <= ego.span_us()[0] and path.span_us()[1] >= ego.span_us()[1]


def test_a_car_that_changes_lane_faces_where_it_goes_and_never_jolts():
    path, _ = changing_lane(straight(pitch=0.02), parse_lateral("-1m@1s,2.5m@4s"), START_US, END_US)
    moments = [1 + 0.05 * i for i in range(61)]
    way = torch.stack([at(path, s)[:3, 3] for s in moments])
    heading = torch.stack([yaw_of(at(path, s)) for s in moments])
    going = torch.atan2(*(way[2:] - way[:-2])[:, :2].flip(1).unbind(1))
    assert torch.allclose(heading[1:-1], going, atol=2e-3)
    assert float(heading.max()) == pytest.approx(math.atan(3.5 / 30 * 15 / 8), abs=1e-3)
    assert float(way.diff(n=2, dim=0).norm(dim=1).max()) / 0.05**2 < 3, "metres per second squared"
    assert float((way[:, 2] - 1.5).abs().max()) < 1e-6


def test_in_a_bend_the_shift_is_square_to_the_road_as_a_steady_one_is():
    ego = road([translation(50 * math.sin(a), 50 * (1 - math.cos(a)), 0) @ yaw(a) for a in (0.02 * torch.arange(61)).tolist()])
    path, _ = changing_lane(ego, parse_lateral("2m@0s,2m@6s"), START_US, END_US)
    steady = ego.shifted(lateral=2)
    for seconds in (0, 0.33, 3, 5.95):
        assert torch.allclose(at(path, seconds), at(steady, seconds), atol=1e-3)


def test_who_waits_changes_lane_as_he_drives_on():
    ego = road([translation(0.0, 0, 0)] * 20 + [translation(1.0 * i, 0, 0) for i in range(1, 41)])
    path, notes = changing_lane(ego, parse_lateral("0m@0s,3m@5s"), START_US, END_US)
    assert notes == [] and torch.allclose(at(path, 1.5), at(ego, 1.5), atol=1e-9)
    assert at(path, 5)[1, 3] == pytest.approx(3)


def test_who_hardly_drives_slides_which_is_told():
    path, (said,) = changing_lane(straight(speed=1), parse_lateral("0m@1s,3m@3s"), START_US, END_US)
    assert said.startswith("the recording car drives 2.0 m from 1s to 3s, too little to go over by 3m")
    assert at(path, 2)[1, 3] == pytest.approx(-2 + 1.5) and float(yaw_of(at(path, 2))) == 0
    still, (said,) = changing_lane(
        Trajectory(torch.tensor([START_US]), translation(0, 0, 1)[None]), parse_lateral("0m@0s,1m@1s"), START_US, END_US
    )
    assert "drives 0.0 m" in said and still.at(START_US)[1, 3] == 0


def test_what_slides_outside_the_clip_is_not_told():
    for text in ("0m@-4s,3m@-2s", "0m@3s,3m@5s"):
        path, notes = changing_lane(straight(speed=1), parse_lateral(text), START_US, START_US + 2 * SECOND)
        assert notes == [] and float(yaw_of(at(path, 4))) == 0, text


def test_a_keyframe_beyond_the_drive_is_only_made_for():
    """At 10 m/s the way from 4 to 8 seconds is half done when the drive ends at 6."""
    path, _ = changing_lane(straight(), parse_lateral("0m@4s,4m@8s"), START_US, END_US)
    assert at(path, 6)[1, 3] == pytest.approx(-2 + 2, abs=1e-6)


def test_keyframes_are_read():
    assert parse_lateral("-2m") == -2.0
    assert parse_lateral("0m@2s, 350cm@5000ms") == (Keyframe(2 * SECOND, 0.0), Keyframe(5 * SECOND, 3.5))


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("2", "has no unit"),
        ("0m,3m@5s", 'does not say when it is "0m"; write it as 0m@2s,3.5m@5s'),
        ("0m@5s,3m@5s", "do not rise: 5s follows 5s"),
        ("3m@5s", "one moment only.*leave out @5s"),
        ("0m@2,3m@5s", '"2" has no unit; write 2s'),
    ],
)
def test_bad_keyframes_are_refused_with_the_fix(text, said):
    with pytest.raises(ValueError, match=said):
        parse_lateral(text)


def drive(scene, tmp_path, rows, end=7 * STEP_US, start=0):
    (tmp_path / "t.csv").write_text("time_s,x_m,y_m\n" + rows)
    return driven(scene, tmp_path / "t.csv", START_US + start, START_US + start + end)


def test_the_recorded_path_written_as_a_file_is_driven_again(street, tmp_path):
    """On a slope, too, with a body that nods; also one that begins later, and turned by the world."""
    y, x = torch.meshgrid(torch.arange(-40.0, 40.0), torch.arange(-40.0, 40.0), indexing="ij")
    poses = [translation(0.5 * i, 1.0, 1.5 + 0.05 * i) @ translation(0, 0, 0.02 * (i % 2)) for i in range(9)]
    ego = Trajectory(street.ego.times_us, yaw(0.5) @ torch.stack(poses))
    hill = replace(street, ego=ego, ground=Ground(0.1 * (math.cos(0.5) * x + math.sin(0.5) * y), (-40.0, -40.0), 1.0))
    path, notes = drive(hill, tmp_path, "".join(f"{i / 10},{0.5 * i},0\n" for i in range(7)), 6 * STEP_US, 2 * STEP_US)
    assert notes == []
    for i in range(7):
        t = START_US + (i + 2) * STEP_US
        assert torch.allclose(path.at(t), ego.at(t), atol=1e-6)


def test_who_creeps_and_shakes_faces_the_way_it_drives(street, tmp_path):
    """As a recorded car does that waits: by a centimetre a row, and millimetres to and fro."""
    rows = "".join(f"{i / 100},{0.01 * i},{0.003 * (i % 3 - 1)}\n" for i in range(81))
    path, _ = drive(street, tmp_path, rows)
    headings = torch.tensor([float(yaw_of(at(path, i / 100))) for i in range(81)]) - float(yaw_of(street.ego.at(START_US)))
    assert float(headings.abs().max()) < math.radians(4)


def test_a_path_of_its_own_follows_the_ground_as_the_recorded_one_did(street, tmp_path):
    """The recorded car went along the crown of a road that falls to both sides, its origin 1.5 m above it."""
    y, _ = torch.meshgrid(torch.arange(-20.0, 20.0), torch.arange(-10.0, 50.0), indexing="ij")
    crowned = replace(street, ground=Ground(-0.02 * y * y, (-10.0, -20.0), 1.0))
    size = torch.tensor(CAR, dtype=torch.float64)

    def stands(x, left, heading=0.0):
        return standing_pose(crowned, torch.tensor([x, left], dtype=torch.float64), heading, size) @ translation(0, 0, 1.5)

    ego = Trajectory(street.ego.times_us, torch.stack([stands(0.5 * i, 0.0) for i in range(9)]))
    path, _ = drive(replace(crowned, ego=ego), tmp_path, "0,0,4\n0.8,4,4\n", 8 * STEP_US)
    for seconds in (0, 0.4, 0.8):
        pose = at(path, seconds)
        assert torch.allclose(pose[:3, :3], stands(5 * seconds, 4.0)[:3, :3], atol=1e-6)
        assert pose[:2, 3].tolist() == pytest.approx([5 * seconds, 4.0])
        assert float(pose[2, 3]) == pytest.approx(float(stands(5 * seconds, 4.0)[2, 3]), abs=1e-6)


def test_without_a_ground_it_stays_in_the_plane_of_the_recorded_body(street, tmp_path):
    bare = replace(street, ground=None)
    path, _ = drive(bare, tmp_path, "0,0,2\n0.8,4,2\n", 8 * STEP_US)
    steady = street.ego.shifted(lateral=2)
    for seconds in (0, 0.45, 0.8):
        assert torch.allclose(at(path, seconds), at(steady, seconds), atol=1e-9)


def test_a_file_that_does_not_last_as_long_as_the_clip_is_refused(street, tmp_path):
    with pytest.raises(ValueError, match=r"t.csv ends 0.5s after the clip's first frame, and the clip's last frame is at 0.7s; add rows"):
        drive(street, tmp_path, "0,0,0\n0.5,4,0\n")
    with pytest.raises(ValueError, match=r"t.csv begins 0.1s after the clip's first frame; let time_s begin at 0"):
        drive(street, tmp_path, "0.1,0,0\n0.8,4,0\n")
    with pytest.raises(ValueError, match="metric"):
        drive(replace(street, meta={**street.meta, "metric": False}), tmp_path, "0,0,0\n0.8,4,0\n")


def test_of_a_long_file_only_the_clip_is_put_on_the_ground(street, tmp_path):
    """An hour's rows took over a minute."""
    path, _ = drive(street, tmp_path, "-3600,-3600,0\n0,0,0\n3600,3600,0\n")
    assert len(path) < 20 and path.span_us()[0] < START_US and path.span_us()[1] > START_US + 7 * STEP_US
    assert torch.allclose(at(path, 0.5)[:3, :3], at(street.ego, 0.5)[:3, :3], atol=1e-6)


def test_a_car_that_slides_is_told(street, tmp_path):
    _, (said,) = drive(street, tmp_path, "0,0,0\n0.4,0,-2\n0.8,-3,-2\n")
    assert said.startswith("the recording car slides sideways 0.") and "t.csv by yaw_deg" in said


def test_on_a_dense_file_a_bend_is_driven_without_steps(street, tmp_path):
    """A hundred rows a second, each less than what tells a direction from the one before."""
    steps = [0.01 * i for i in range(81)]
    rows = "".join(f"{t},{10 * math.sin(0.5 * t)},{10 * (1 - math.cos(0.5 * t))}\n" for t in steps)
    path, _ = drive(street, tmp_path, rows, 8 * STEP_US)
    facing = torch.stack([yaw_of(at(path, t)) for t in steps])
    assert torch.allclose(facing[10:-10], 0.5 * torch.tensor(steps, dtype=torch.float64)[10:-10], atol=1e-2)
    assert float(facing[10:-10].diff().diff().abs().max()) < 2e-3
