import math
from dataclasses import replace

import pytest
import torch
from street import START_US, box, car

from render.aside import path_warning, room_aside, sight_warning
from render.clip import clip_cameras
from scenes import Actor, Asset, Gaussians, OpenCV, Trajectory
from scenes.ego_path import changing_lane
from scenes.lateral import parse_lateral
from scenes.poses import translation, yaw

CAMERA = "front_camera"


def room(scene, left, reach=500.0):
    return room_aside(scene, scene.camera(CAMERA, START_US + 300_000), scene.ego.at(START_US + 300_000), left, reach)


def told(scene, shift):
    return path_warning(scene, clip_cameras(scene, CAMERA), shift, f"--lateral-shift {shift:g}m")


def test_a_camera_can_go_aside_up_to_the_houses(street):
    """Whose fronts stand 8.5 m from the path, on both sides."""
    assert room(street, True) == pytest.approx(8.5 - 0.5, abs=0.6) and room(street, False) == pytest.approx(8.5 - 0.5, abs=0.6)
    assert room(street, True, reach=3.0) == 3


def without_houses(street):
    g = street.background.gaussians
    return replace(street, background=replace(street.background, gaussians=g.select(g.means[:, 2] < 0.1)))


def test_where_nothing_stands_the_known_ground_ends(street):
    bare = without_houses(street)
    assert room(bare, True) == pytest.approx(19, abs=0.5) and room(bare, False) == pytest.approx(20, abs=0.5)


def test_what_drives_beside_the_path_is_in_nobodys_way(street):
    wide = Asset(box((30.0, 1.8, 3.0), (0.5, 0.5, 0.5)), (30.0, 1.8, 3.0), "truck")
    beside = Actor(wide, Trajectory(torch.zeros(1, dtype=torch.int64), translation(5.0, 4.0, 0.0)[None]), "t")
    assert room(replace(street, actors=(beside,)), True) == room(street, True)


def test_a_shift_to_where_nothing_was_recorded_is_told_with_the_largest_short_of_it(street):
    (said,) = told(street, 500.0)
    assert "500m goes beyond" in said and "m to the left of the path" in said
    largest = float(said.rpartition(" is ")[2].rstrip("m"))
    assert 7 <= largest <= 8 and not any("beyond" in said for shift in (largest, -largest, 0.0) for said in told(street, shift))
    (said,) = told(street, -500.0)
    assert "to the right" in said and said.endswith(f"is {-largest:g}m")


def test_over_an_open_street_too_a_shift_farther_than_is_measured_is_told(street):
    """But not one by a lane."""
    bare = without_houses(street)
    assert not told(bare, 3.5) and not told(bare, -3.5)
    for shift in (5.0, -12.0):
        (said,) = told(bare, shift)
        assert said.startswith(f"--lateral-shift {shift:g}m leads far beside the recorded path") and said.endswith("stay within 3m of it")


def test_a_lane_change_that_leads_farther_than_is_measured_says_when(street):
    bare = without_houses(street)

    def over_by(left):
        path, _ = changing_lane(street.ego, parse_lateral(f"0m@0s,{left}m@300ms"), START_US, START_US + 700_000)
        return path_warning(bare, clip_cameras(bare, CAMERA), path, "--lateral-shift")

    assert not over_by(3.5)
    (said,) = over_by(-8)
    assert said.startswith("--lateral-shift is 8.0 m beside the recorded path, 0.3s after the clip's first frame: ")


def test_beside_a_wall_no_shift_makes_sense(street):
    wall = box((30.0, 0.3, 3.0), (0.6, 0.6, 0.6))
    wall = replace(wall, means=wall.means + torch.tensor([5.0, 0.6, 0.0]))
    walled = replace(street, background=replace(street.background, gaussians=Gaussians.cat([street.background.gaussians, wall])))
    (said,) = told(walled, 2.0)
    assert said.endswith("no shift to that side makes sense") and not told(walled, -2.0)


def test_a_car_below_the_cameras_eye_is_in_the_cars_way(street):
    """The camera, 1.5 m above the ground, looks over it and at the houses behind."""
    low = box((4.2, 1.8, 0.9), (0.7, 0.2, 0.2))
    low = replace(low, means=low.means + torch.tensor([4.0, -2.5, 0.0]))
    parked = replace(street, background=replace(street.background, gaussians=Gaussians.cat([street.background.gaussians, low])))
    assert room(parked, False, reach=3.0) == 3
    (said,) = told(parked, -2.5)
    assert "-2.5m takes the recording car through what stands there" in said and said.endswith("at -0.5m its way is free")
    assert not told(parked, -0.5) and not told(parked, 2.5) and not told(street, -2.5)


def test_a_parked_car_is_in_the_cars_way_also_where_few_splats_are_in_it(street):
    """As of one that stood beside the path's beginning, of which the pictures showed little."""
    entry = {"track": "veh_3", "label": "Car", "size": [4.5, 1.8, 1.5], "world_from_box": translation(3.0, -2.5, 0.0).tolist()}
    (said,) = told(replace(street, meta={**street.meta, "parked": [entry]}), -2.5)
    assert "-2.5m takes the recording car through veh_3 (Car), 0." in said and said.endswith("at -0.5m its way is free")


def test_in_a_corridor_that_no_car_fits_into_a_robot_can_go_aside_a_little(street):
    """Walls 0.7 m to either side, from the floor up: what drove between them is narrower than a car."""
    walls = [box((30.0, 0.2, 3.0), (0.3, 0.1, 0.3)) for _ in range(2)]
    walls = [replace(w, means=w.means + torch.tensor([5.0, side, 0.0])) for w, side in zip(walls, (0.8, -0.8), strict=True)]
    corridor = replace(street, background=replace(street.background, gaussians=Gaussians.cat([street.background.gaussians, *walls])))
    assert not told(corridor, 0.1)
    (said,) = told(corridor, 0.6)
    assert "something stands" in said and said.endswith(("short of that is 0.1m", "short of that is 0.2m"))


def test_an_actor_is_in_the_cars_way_as_long_as_it_is_there(street):
    beside = Actor(car(), Trajectory(torch.zeros(1, dtype=torch.int64), translation(6.0, 2.5, 0.0)[None]), "t")
    (said,) = told(replace(street, actors=(beside,)), 2.5)
    assert "through t (car), 0." in said and said.endswith("at 0.5m its way is free")
    away = replace(
        beside,
        trajectory=Trajectory(street.ego.times_us[-1:] + torch.tensor([10**7, 2 * 10**7]), translation(6.0, 2.5, 0.0).repeat(2, 1, 1)),
    )
    assert not told(replace(street, actors=(away,)), 2.5)


def test_a_path_of_its_own_is_told_where_it_meets_something(street):
    """Like a shift, but of the moment: it goes over to a parked car's place, or past the houses, halfway."""
    ego, cameras = street.ego, clip_cameras(street, CAMERA)
    beside = Actor(car(), Trajectory(torch.zeros(1, dtype=torch.int64), translation(6.0, 2.5, 0.0)[None]), "t")

    def driving(left):
        """Along the recorded path, and so far to the left in the second half of it."""
        poses = ego.world_from_body.clone()
        poses[len(ego) // 2 :, 1, 3] += left
        return Trajectory(ego.times_us, poses)

    (said,) = path_warning(replace(street, actors=(beside,)), cameras, driving(2.5), "--trajectory t.csv")
    assert said.startswith("--trajectory t.csv takes the recording car through t (car), 0.") and said.endswith("lead it past there")
    (said,) = path_warning(street, cameras, driving(12.0), "--trajectory t.csv")
    assert "goes beyond what was recorded: 0." in said and "it is 12.0 m to the left of the recorded path, and something stands 8." in said
    assert not path_warning(street, cameras, driving(2.5), "--trajectory t.csv")


def test_a_path_that_goes_on_where_the_recorded_one_ends_is_told_of_the_grounds_edge(street):
    """Straight on along the street, and a kilometre back: it is nowhere aside of the recorded path."""
    ego, cameras = street.ego, clip_cameras(street, CAMERA)
    for far in (1000.0, -1000.0):
        poses = ego.world_from_body.clone()
        poses[len(ego) // 2 :, 0, 3] += far
        (said,) = path_warning(street, cameras, Trajectory(ego.times_us, poses), "--trajectory t.csv")
        assert said.startswith("--trajectory t.csv leaves the known ground 0.") and said.endswith("stay nearer to the recorded path")


def test_a_path_that_looks_where_no_camera_did_is_told(street):
    def turned(angle):
        return replace(street.ego, world_from_body=street.ego.world_from_body @ yaw(angle))

    cameras = clip_cameras(street, CAMERA)
    (said,) = path_warning(street, cameras, turned(math.pi), "--trajectory t.csv")
    assert "looks " in said and "deg away from where any camera looked there, 0.0s after" in said
    assert not path_warning(street, cameras, turned(0.5), "--trajectory t.csv")


def test_a_camera_of_ones_own_that_sees_what_no_camera_did_is_told(street):
    def told_of(mount=None, **changed):
        """Of a camera like the front one with another mount, seen from that one, or another lens."""
        front = street.rig[CAMERA]
        own = replace(front, body_from_cam=front.body_from_cam if mount is None else mount @ front.body_from_cam, **changed)
        scene = replace(street, own={"own.json": own})
        return sight_warning(scene, "own.json", clip_cameras(scene, "own.json"))

    assert told_of() == [] and told_of(yaw(0.4)) == []
    (said,) = told_of(yaw(math.pi))
    share = int(said.split(" on ")[1].split("%")[0])
    assert said.startswith("own.json shows what no camera recorded on ") and share > 50 and said.endswith("narrow its view")
    assert told_of(translation(y=3.0)) == []
    (said, *_) = told_of(translation(y=12.0))
    assert said.startswith("own.json is 12.0 m from the nearest recorded camera, and something stands 8.") and "move it nearer" in said
    (said,) = [line for line in told_of(lens=OpenCV(57.6, 57.6, 48.0, 27.0, -1.0)) if "distortion" in line]
    assert said.startswith("own.json sees nothing on ") and "check the numbers and their order" in said


def test_a_camera_of_ones_own_far_from_where_the_recorded_ones_drove_is_told(street):
    """Beside or above them, by its mount and the path together; but not one that is ahead, or that only a shift leads there."""
    bare = without_houses(street)

    def told_of(mount, shift=0.0):
        front = bare.rig[CAMERA]
        scene = replace(bare, own={"own.json": replace(front, body_from_cam=mount @ front.body_from_cam)})
        told = sight_warning(scene, "own.json", clip_cameras(scene, "own.json", shift))
        return [line for line in told if "measured" in line]

    for mount, off in ((translation(y=-6.0), "6.0"), (translation(z=5.0), "5.0"), (translation(y=3.0, z=4.0), "5.0")):
        (said,) = told_of(mount)
        assert said.startswith(f"own.json is {off} m beside or above where any recorded camera drove: ")
        assert said.endswith("mount it within 3m of there")
    assert not told_of(translation(y=3.5)) and not told_of(translation(x=8.0)) and not told_of(translation(x=1.0), 6.0)
    (said,) = told_of(translation(y=2.0), 2.0)
    assert said.startswith("own.json is 4.0 m")
    assert not told_of(translation(y=2.0), -2.0)
