import math
from dataclasses import replace

import pytest
import torch
from street import START_US, STEP_US, car

from scenes import Ground, Trajectory
from scenes.insert import insert
from scenes.placement import Placement
from scenes.poses import pose_from, translation, yaw, yaw_of
from scenes.standing import standing_pose


def ramp(rise=0.1, bank=0.0):
    """A ground that rises along x and along y."""
    y, x = torch.meshgrid(torch.arange(-20.0, 20.0), torch.arange(-10.0, 50.0), indexing="ij")
    return Ground(rise * x + bank * y, (-10.0, -20.0), 1.0)


def test_a_parked_asset_stands_where_it_was_put(street):
    result = insert(street, car(), Placement("car/0001", 12, 4.8, math.radians(5)))
    assert result.warnings == ()
    assert result.scene.actors == (*street.actors, result.actor)
    assert result.actor.track == "inserted_car_0001"
    pose = result.actor.trajectory.at(START_US + 123)
    assert pose[:3, 3].tolist() == pytest.approx([12, 4.8, 0])
    assert float(yaw_of(pose)) == pytest.approx(math.radians(5))


def test_places_are_relative_to_the_body_at_the_first_frame(street):
    turned = Trajectory(street.ego.times_us, translation(5, 1, 2) @ yaw(math.pi / 2) @ street.ego.world_from_body)
    later = insert(replace(street, ego=turned), car(), Placement("car", 10, 2), start_us=START_US + 4 * STEP_US)
    # the body has gone 2 m along world y to (5, 3), and faces along y: 10 m forward is +y, 2 m left is -x
    assert later.actor.trajectory.at(START_US)[:3, 3].tolist() == pytest.approx([3, 13, 0])


def test_a_moving_asset_goes_along_its_heading(street):
    result = insert(street, car(), Placement("car", 10, 0, math.pi / 2, speed=8), start_us=START_US + STEP_US)
    path = result.actor.trajectory
    assert path.at(START_US + STEP_US)[:3, 3].tolist() == pytest.approx([10.5, 0, 0])
    assert path.at(START_US + 6 * STEP_US)[:3, 3].tolist() == pytest.approx([10.5, 4, 0])
    assert path.at(START_US)[:3, 3].tolist() == pytest.approx([10.5, -0.8, 0])  # it was on its way before the clip began


def test_an_asset_tilts_with_the_ground(street):
    hill = replace(street, ground=ramp(rise=0.1, bank=0.05))
    for heading in (0.0, 1.0, math.pi):
        pose = standing_pose(hill, torch.tensor([10.0, 2.0], dtype=torch.float64), heading, car().size)
        normal = torch.tensor([-0.1, -0.05, 1.0], dtype=torch.float64)
        assert torch.allclose(pose[:3, 2], normal / normal.norm(), atol=1e-6)
        assert torch.allclose(pose[:3, :3] @ pose[:3, :3].T, torch.eye(3, dtype=torch.float64), atol=1e-12)
        assert float(pose[2, 3]) == pytest.approx(0.1 * 10 + 0.05 * 2, abs=1e-6)
        assert float(yaw_of(pose)) == pytest.approx(heading, abs=1e-6)


def test_wheels_stay_on_the_ground_along_the_way(street):
    hill = replace(street, ground=ramp(0.2))
    path = insert(hill, car(), Placement("car", 5, 0, speed=10)).actor.trajectory
    for t in range(START_US, START_US + 8 * STEP_US, 30_000):
        x, _, z = path.at(t)[:3, 3].tolist()
        assert z == pytest.approx(0.2 * x, abs=1e-3)


def test_leaving_the_known_ground_is_said(street):
    result = insert(street, car(), Placement("car", 60, 0))
    (warning,) = result.warnings
    assert "11.0 m beyond the known ground" in warning


def test_without_a_ground_the_lowest_splats_carry_it_and_that_is_said(street):
    result = insert(replace(street, ground=None), car(), Placement("car", 12, 0))
    assert "no ground" in result.warnings[0]
    assert abs(float(result.actor.trajectory.at(START_US)[2, 3])) < 0.1
    with pytest.raises(ValueError, match="nearer"):
        insert(replace(street, ground=None), car(), Placement("car", 1000, 0))


def test_one_asset_can_be_inserted_many_times(street):
    scene = street
    for i in range(3):
        scene = insert(scene, car(), Placement("car/0001", 10 + 6 * i, 3)).scene
    assert [a.track for a in scene.actors[1:]] == ["inserted_car_0001", "inserted_car_0001_2", "inserted_car_0001_3"]


def test_an_inserted_track_is_none_that_an_edit_speaks_of(street):
    edits = [
        {"name": "inserted_car_0001", "kind": "insert"},
        {"name": "edit", "kind": "edit", "remove": ["inserted_car_0001_2"], "shift_m": {"inserted_car_0001_3": [0.0, 1.0]}},
        {"name": "inserted_car_0001_4", "missing": True},
    ]
    edited = replace(street, meta={**street.meta, "edits": edits})
    assert insert(edited, car(), Placement("car/0001", 12, 3)).actor.track == "inserted_car_0001_4"


def test_an_inserted_track_is_not_that_of_a_layer_that_a_kill_left(street, tmp_path):
    (tmp_path / "edits").mkdir()
    (tmp_path / "edits" / "inserted_car_0001.usda").touch()
    killed = replace(street, meta={**street.meta, "path": str(tmp_path)})
    assert insert(killed, car(), Placement("car/0001", 12, 3)).actor.track == "inserted_car_0001_2"


def on_way(street, file, rows):
    file.write_text("time_s,x_m,y_m\n" + rows)
    return insert(street, car(), Placement("car", trajectory=file), start_us=START_US)


def test_what_stops_on_its_way_turns_as_it_drives_on(street, tmp_path):
    path = on_way(street, tmp_path / "t.csv", "0,10,0\n1,20,0\n3,20,0\n4,24,3\n5,28,6\n").actor.trajectory
    turned = math.degrees(math.atan2(3, 4))
    for after, degrees in ((0, 0), (1, 0), (2, 0), (3, 0), (3.5, turned / 2), (4, turned), (5, turned)):
        assert math.degrees(float(yaw_of(path.at(START_US + round(1e6 * after))))) == pytest.approx(degrees, abs=0.01), after
    waits = on_way(street, tmp_path / "t.csv", "0,10,0\n1,10,0\n2,10,4\n3,14,4\n").actor.trajectory
    assert float(yaw_of(waits.at(START_US))) == pytest.approx(math.pi / 2), "it waits as it will set off"


def test_a_trajectory_on_which_it_slides_sideways_is_told(street, tmp_path):
    (told,) = on_way(street, tmp_path / "t.csv", "0,16,-3\n2,12,-3\n4,16,-3\n").warnings
    assert "slides sideways 2.4s after the clip's first frame; say in" in told and "t.csv by yaw_deg" in told
    assert on_way(street, tmp_path / "t.csv", "0,10,-3\n1,14,-3\n1.5,16,-3\n1.6,16,-3.1\n").warnings == ()


def test_a_trajectory_file_is_followed(street, tmp_path):
    (tmp_path / "t.csv").write_text("time_s,x_m,y_m\n0,10,0\n0.3,13,0\n0.6,13,3\n")
    result = insert(street, car(), Placement("car", trajectory=tmp_path / "t.csv"), start_us=START_US)
    path = result.actor.trajectory
    assert path.at(START_US + 150_000)[:2, 3].tolist() == pytest.approx([11.5, 0])
    assert path.at(START_US + 450_000)[:2, 3].tolist() == pytest.approx([13, 1.5])
    headings = [float(yaw_of(path.at(START_US + t))) for t in (0, 300_000, 600_000)]
    assert headings == pytest.approx([0, math.pi / 4, math.pi / 2])
    assert not path.covers(START_US + 800_000)


def test_a_body_that_is_turned_and_tilted_says_where_forward_and_left_are(street, tmp_path):
    """On the level: what it leans does not bring nearer what stands to its left."""
    leaning = pose_from([math.cos(0.2), math.sin(0.2), 0.0, 0.0], [0.0, 0.0, 0.0])
    ego = Trajectory(street.ego.times_us, translation(5, 1, 0) @ yaw(math.pi / 2) @ street.ego.world_from_body @ leaning)
    turned = replace(street, ego=ego)
    for actor in (
        on_way(turned, tmp_path / "t.csv", "0,10,2\n1,14,2\n").actor,
        insert(turned, car(), Placement("car", 10, 2), start_us=START_US).actor,
    ):
        pose = actor.trajectory.at(START_US)
        assert pose[:2, 3].tolist() == pytest.approx([3, 11]) and float(yaw_of(pose)) == pytest.approx(math.pi / 2)


def test_yaw_goes_the_shorter_way_round(street, tmp_path):
    (tmp_path / "t.csv").write_text("time_s,x_m,y_m,yaw_deg\n0,10,0,170\n0.4,10,1,-170\n")
    path = insert(street, car(), Placement("car", trajectory=tmp_path / "t.csv"), start_us=START_US).actor.trajectory
    assert abs(float(yaw_of(path.at(START_US + 200_000)))) == pytest.approx(math.pi)


def test_a_start_off_the_drive_is_refused(street):
    with pytest.raises(ValueError, match="car cannot be placed 10s after the drive's first moment; the drive lasts 0.8s"):
        insert(street, car(), Placement("car", 10, 0), start_us=START_US + 10_000_000)


def test_times_that_are_no_seconds_of_a_drive_are_refused(street, tmp_path):
    for last in (8000, 1557539956):  # milliseconds, and since 1970
        (tmp_path / "t.csv").write_text(f"time_s,x_m,y_m\n0,10,0\n{last},20,0\n")
        with pytest.raises(ValueError, match=r"t.csv.*no milliseconds, and not since 1970"):
            insert(street, car(), Placement("car", trajectory=tmp_path / "t.csv"))


def test_places_that_are_no_metres_of_a_drive_are_refused(street, tmp_path):
    for row, name in (("1,691000,3", "x_m"), ("1,20,-5.3e6", "y_m")):  # as UTM has them
        (tmp_path / "t.csv").write_text(f"time_s,x_m,y_m\n0,10,0\n{row}\n")
        with pytest.raises(ValueError, match=f"t.csv has the {name} .* more than 100 km .*; {name} counts metres from there"):
            insert(street, car(), Placement("car", trajectory=tmp_path / "t.csv"))


def test_what_is_never_there_during_the_drive_is_said(street, tmp_path):
    (tmp_path / "t.csv").write_text("time_s,x_m,y_m\n-9,10,0\n-5,20,0\n")
    result = insert(street, car(), Placement("car", trajectory=tmp_path / "t.csv"))
    assert "car is there from -9s to -5s only, and never during the drive" in result.warnings


def test_what_an_asset_runs_into_is_looked_for_in_the_clip_alone(street):
    """veh_1 stands 10 m ahead at first, and has left half a second later."""
    other = street.actors[0]
    path = other.trajectory
    poses = path.world_from_body.clone()
    poses[:, 0, 3], poses[:, 1, 3] = 10.0 + 5.0 * torch.arange(len(path)), 0.0
    scene = replace(street, actors=(replace(other, trajectory=replace(path, world_from_body=poses)),))
    late = int(path.times_us[5])
    body = scene.ego.at(late)[0, 3]
    place = Placement("car", 10.0 - float(body), 0.0)
    assert any("runs into" in said for said in insert(scene, car(), place, late).warnings)
    assert not any("runs into" in said for said in insert(scene, car(), place, late, int(path.times_us[-1])).warnings)


def test_what_the_recording_car_drives_into_is_told_of_the_path_that_it_drives(street):
    place, start = Placement("car", 3.0, 0.0), street.ego.times_us
    aside = street.ego.shifted(lateral=3.5)
    assert any("where the recording car drives" in said for said in insert(street, car(), place).warnings)
    assert not any("recording car" in said for said in insert(street, car(), place, int(start[0]), int(start[-1]), aside).warnings)
    beside = Placement("car", 3.0, 3.5)
    assert any("recording car" in said for said in insert(street, car(), beside, int(start[0]), int(start[-1]), aside).warnings)
