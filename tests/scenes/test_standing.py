"""What takes a recorded actor's place stands on the ground, not where a lidar box was by centimetres off it."""

from dataclasses import replace

import pytest
import torch
from street import START_US, STEP_US, car, street

from scenes import Ground, Trajectory, load, save
from scenes.edit import Edit, edited
from scenes.poses import translation, yaw, yaw_of
from scenes.standing import EDGE, FAR, moved, standing_pose, stood
from scenes.usd.edit import add_change
from scenes.usd.undo import undo

TIMES = START_US + STEP_US * torch.arange(9)
BANK = Ground((0.05 * torch.arange(-20.0, 20.0))[:, None].expand(40, 60).contiguous(), (-10.0, -20.0), 1.0)


def recorded(heights, step=0.5) -> Trajectory:
    """A level box that goes along y = -3, turned by a little, at heights `[9]` over what `BANK` has there."""
    return Trajectory(TIMES, torch.stack([translation(8 + step * i, -3.0, -0.15 + float(h)) @ yaw(0.1) for i, h in enumerate(heights)]))


def hill(path: Trajectory):
    scene = replace(street(), ground=BANK)
    return replace(scene, actors=(replace(scene.actors[0], trajectory=path),))


def test_an_asset_in_anothers_place_stands_on_the_ground_and_tilts_with_it(tmp_path):
    noise = torch.tensor([0.03, -0.05, 0.2, 0.28, -0.25, 0.0, 0.1, -0.1, 0.05])
    scene, van = hill(recorded(noise)), car("van")
    save(scene, tmp_path / "s1")
    add_change(tmp_path / "s1", "mine", load(tmp_path / "s1"), Edit(replace={"veh_1": van}), {})
    was = scene.actors[0].trajectory.world_from_body
    wanted = torch.stack([standing_pose(scene, pose[:2, 3], 0.1, van.size) for pose in was])
    assert (wanted[:, 2, 1] > 0.04).all(), "the bank tilts it"
    for after in (load(tmp_path / "s1"), edited(scene, Edit(replace={"veh_1": van}))):
        path = after.actors[0].trajectory
        assert torch.equal(path.times_us, TIMES)
        torch.testing.assert_close(path.world_from_body, wanted, atol=1e-6, rtol=0)
        torch.testing.assert_close(path.world_from_body[:, :2, 3], was[:, :2, 3], atol=1e-9, rtol=0)
        torch.testing.assert_close(yaw_of(path.world_from_body), yaw_of(was), atol=1e-6, rtol=0)
    undo(tmp_path / "s1", "mine")
    torch.testing.assert_close(load(tmp_path / "s1").actors[0].trajectory.world_from_body, was, atol=1e-6, rtol=0)


@pytest.mark.parametrize("height", [FAR + 0.01, 6.0, -FAR - 0.01])
def test_on_a_bridge_and_where_the_ground_is_a_guess_the_recorded_box_counts(height):
    path = recorded([height] * 9)
    torch.testing.assert_close(stood(path, car().size, hill(path)).world_from_body, path.world_from_body, atol=1e-9, rtol=0)


@pytest.mark.parametrize("end", [2.0, -2.0])
def test_what_leaves_the_ground_for_a_bridge_goes_over_smoothly(end):
    rise = torch.linspace(0, end, 201)
    times = START_US + 1000 * torch.arange(201)
    path = Trajectory(times, torch.stack([translation(8.0, -3.0, -0.15 + float(h)) for h in rise]))
    after = stood(path, car().size, hill(path)).world_from_body
    assert float(after[0, 2, 3]) == pytest.approx(-0.15) and float(after[-1, 2, 3]) == pytest.approx(end - 0.15)
    steps = after[:, 2, 3].diff() / (end / 200)
    assert (steps > -1e-6).all() and (steps < 4).all(), "up with the box, and nowhere a jump"
    assert (after[:, 2, 1].diff().abs() < 0.005).all(), "the tilt goes over, too"


def test_beyond_the_edge_of_the_ground_it_counts_less_and_less():
    outside = torch.tensor([-1.0, 0.0, EDGE / 2, EDGE, 3 * EDGE])
    path = Trajectory(TIMES[:5], torch.stack([translation(49.0 + float(x), -3.0, 0.05) for x in outside]))
    heights = stood(path, car().size, hill(path)).world_from_body[:, 2, 3]
    assert heights.tolist() == pytest.approx([-0.15, -0.15, -0.05, 0.05, 0.05], abs=1e-6)


def test_without_a_ground_the_recorded_path_stays():
    path = recorded([0.1] * 9)
    assert stood(path, car().size, replace(hill(path), ground=None)) is path


def test_what_is_shifted_up_a_slope_climbs_with_the_ground_and_no_further():
    """A body that is tilted as the slope is would climb by itself, and by the ground once more."""
    rise = Ground((0.2 * torch.arange(-10.0, 50.0)).expand(40, 60).contiguous(), (-10.0, -20.0), 1.0)
    scene = replace(street(), ground=rise)
    places = torch.tensor([[8.0 + 0.5 * i, -3.0] for i in range(9)], dtype=torch.float64)
    high = translation(z=0.1)
    path = Trajectory(TIMES, torch.stack([high @ standing_pose(scene, xy, 0.0, car().size) for xy in places]))
    for by in ((3.0, 0.0), (-3.0, 1.0)):
        after = moved(path, by, car().size, scene).world_from_body
        wanted = torch.stack([high @ standing_pose(scene, xy, 0.0, car().size) for xy in after[:, :2, 3]])
        torch.testing.assert_close(after, wanted, atol=1e-6, rtol=0)
        assert (after[:, 0, 3] - places[:, 0]).tolist() == pytest.approx([by[0] / 1.04**0.5] * 9), "metres along the slope"
