"""Lane-parallel paths, what they run into, and the light that an asset takes on."""

import math
from dataclasses import replace

import pytest
import torch
from street import START_US, STEP_US, box, car

from scenes import Actor, Gaussians, Ground, Placed, Trajectory
from scenes.collide import boxes_touch, collisions, into
from scenes.harmonics import evaluate, rgb_from_sh, sh_from_rgb
from scenes.insert import insert
from scenes.lane import Lane
from scenes.match import ground_linear, matched, relit
from scenes.placement import Placement, parse_placement
from scenes.poses import inverse, translation, yaw, yaw_of
from scenes.sky import linear_from_srgb, srgb_from_linear

RADIUS = 30.0


def bend(step=1.0) -> Trajectory:
    """A body that stands for a while, shaking, then drives a circle to the left about (0, 30)."""
    dice = torch.Generator().manual_seed(0)
    shake = [translation(*(0.02 * torch.randn(2, generator=dice)).tolist()) for _ in range(6)]
    turn = [translation(0, RADIUS) @ yaw(step * i / RADIUS) @ translation(0, -RADIUS) for i in range(1, 41)]
    poses = torch.stack([*shake, *turn])
    return Trajectory(START_US + STEP_US * torch.arange(len(poses)), poses)


@pytest.mark.parametrize("left", [-3.5, 0.0, 3.5])
def test_a_lane_keeps_its_distance_to_the_path(left):
    lane = Lane(bend())
    xy, headings = lane.at(torch.linspace(5, 35, 40, dtype=torch.float64), left)
    away = (xy - torch.tensor([0.0, RADIUS], dtype=torch.float64)).norm(dim=1)
    torch.testing.assert_close(away, torch.full_like(away, RADIUS - left), atol=0.05, rtol=0)
    steps = xy.diff(dim=0)
    torch.testing.assert_close(torch.atan2(steps[:, 1], steps[:, 0]), (headings[1:] + headings[:-1]) / 2, atol=0.03, rtol=0)


def test_a_place_in_a_lane_is_found_again():
    lane = Lane(bend())
    for along in (-6.0, 0.5, 10.0, 25.0, 38.0, 50.0):
        for left in (-4.0, 0.0, 2.5):
            xy, _ = lane.at(torch.tensor([along], dtype=torch.float64), left)
            assert lane.of(xy[0]) == pytest.approx((along, left), abs=0.05)


def test_a_body_that_only_stands_gives_its_heading():
    lane = Lane(Trajectory(torch.tensor([0, 1]), torch.stack([yaw(0.3), yaw(0.3) @ translation(0.01)])))
    _, heading = lane.at(torch.tensor([-5.0, 20.0], dtype=torch.float64), 2.0)
    assert heading.tolist() == pytest.approx([0.3, 0.3])


def test_assets_follow_the_lane_and_oncoming_ones_come_back(street):
    scene = replace(street, ego=bend(), ground=Ground(torch.zeros(200, 200), (-100.0, -100.0), 1.0), actors=())
    for turn, way in ((0.0, 1), (math.pi, -1)):
        path = insert(scene, car(), Placement("car", 20, 3.5, turn, 8.0, "lane"), START_US).actor.trajectory
        now, later = path.at(START_US), path.at(START_US + 1_000_000)
        assert now[:2, 3].tolist() == pytest.approx([20, 3.5], abs=0.2)  # from where it was put
        moved = later[:2, 3] - now[:2, 3]
        assert float(moved.norm()) == pytest.approx(8, rel=0.02)
        assert float(moved @ now[:2, 0]) > 7  # it goes where it faces
        centre = torch.tensor([0.0, RADIUS], dtype=torch.float64)
        angle = [math.atan2(*(p[:2, 3] - centre).flip(0).tolist()) for p in (now, later)]
        assert (angle[1] - angle[0]) * way > 0


def test_the_way_is_written_as_a_key():
    assert parse_placement("car/0003@12m,3.5m,speed=8m/s,path=lane").path == "lane"
    with pytest.raises(ValueError, match="one of straight, lane. Did you mean lane"):
        parse_placement("car/0003@12m,3.5m,path=lan")


def test_a_way_that_is_free_is_not_complained_of(street):
    assert insert(street, car(), Placement("car", 12, -2.5)).warnings == ()
    assert insert(street, car(), Placement("car", 10, -2.5, speed=5.0, path="lane")).warnings == ()


def test_running_into_an_actor_is_said_with_the_first_moment(street):
    # veh_1 comes from x = 22 at 8 m/s on y = 2.5; noses touch when 22 - 8 t - 2.1 < 17 + 2.1 - slack
    (said,) = insert(street, car(), Placement("car", 17, 2.5)).warnings
    assert "runs into veh_1 (car) 0.2s after" in said or "runs into veh_1 (car) 0.1s after" in said
    assert insert(street, car(), Placement("car", 17, -0.5)).warnings == ()


def test_boxes_touch_as_the_plane_says(street):
    other, across = street.actors[0], math.pi / 2
    for x, y, turn, touch in ((0, 1.6, 0, True), (0, 1.9, 0, False), (0, 2.6, across, True), (0, 3.1, across, False), (4, 0, 0, True)):
        pose = other.trajectory.at(START_US) @ translation(x, y) @ yaw(turn)
        mine = replace(other, track="me", trajectory=Trajectory(torch.tensor([START_US]), pose[None]))
        assert boxes_touch(mine, other, START_US) is boxes_touch(other, mine, START_US) is touch, (x, y)
    high = replace(mine, trajectory=Trajectory(torch.tensor([START_US]), (pose @ translation(z=5.0))[None]))
    assert not boxes_touch(high, other, START_US)


@pytest.mark.parametrize(("metres", "touch"), [(1.35, True), (1.45, False)])
def test_what_stands_on_another_touches_it_where_their_heights_overlap(metres, touch):
    """By more than the air that annotators leave; cars are 1.5 m high."""
    below, above = (
        Actor(car(), Trajectory(torch.tensor([START_US]), translation(0.0, 0.0, z)[None]), name) for name, z in (("a", 0.0), ("b", metres))
    )
    assert boxes_touch(below, above, START_US) == boxes_touch(above, below, START_US) == touch


def test_what_stands_in_the_way_is_met_in_whatever_frame_the_background_stands(street):
    there = translation(3.0, -7.0, 1.0) @ yaw(0.5)
    back = inverse(there).float()
    splats = street.background.gaussians
    turned = replace(street, background=Placed(replace(splats, means=splats.means @ back[:3, :3].T + back[:3, 3]), there))
    poses = torch.stack([translation(12.0, y, 0.0) for y in (4.0, 8.0, 9.0)])
    actor = Actor(car(), Trajectory(START_US + STEP_US * torch.arange(3), poses), "new")
    hits = [into(scene, actor, actor.trajectory.times_us.tolist()) for scene in (street, turned)]
    assert hits[0] is not None and hits[0] == hits[1] and hits[0][0] > START_US


def test_standing_in_a_house_is_said_and_a_kerb_and_a_bridge_above_are_not(street):
    inside = insert(street, car(), Placement("car", 12, 9))
    assert any("stands in something of the background" in w for w in inside.warnings)
    kerb = box((6.0, 3.0, 0.2), (0.5, 0.5, 0.5))
    kerb = replace(kerb, means=kerb.means + torch.tensor([12.0, -2.5, 0.0]))
    background = Placed(Gaussians.cat([street.background.gaussians, kerb]), street.background.world_from_local)
    assert collisions(replace(street, background=background), insert(street, car(), Placement("car", 12, -2.5)).actor) == {}
    bridge = box((6.0, 8.0, 0.5), (0.5, 0.5, 0.5))
    bridge = replace(bridge, means=bridge.means + torch.tensor([12.0, -2.5, 1.7]))
    background = Placed(Gaussians.cat([street.background.gaussians, bridge]), street.background.world_from_local)
    assert collisions(replace(street, background=background), insert(street, car(), Placement("car", 12, -2.5)).actor) == {}


def test_what_stands_in_a_parked_car_is_told_by_its_box_and_once(street):
    """A cone in its middle meets none of its splats, a car all of them."""
    body = box((3.6, 1.4, 0.6), (0.2, 0.2, 0.2))
    body = replace(body, means=body.means + torch.tensor([12.0, -2.5, 0.4]))
    where = translation(12.0, -2.5, 0.0).tolist()
    meta = {**street.meta, "parked": [{"track": "veh_7", "label": "Car", "size": [4.5, 1.9, 1.6], "world_from_box": where}]}
    background = Placed(Gaussians.cat([street.background.gaussians, body]), street.background.world_from_local)
    full = replace(street, background=background, meta=meta)
    cone = replace(car(), size=torch.tensor([0.3, 0.3, 0.7], dtype=torch.float64), label="cone")
    for asset in (cone, car()):
        told = collisions(full, insert(full, asset, Placement(asset.label, 12, -2.5)).actor)
        assert list(told) == ["actor veh_7"] and "runs into veh_7 (Car) 0.0s after" in told["actor veh_7"]
    assert collisions(full, insert(full, cone, Placement("cone", 12, 2.5)).actor) == {}
    assert list(collisions(replace(full, meta=street.meta), insert(full, car(), Placement("car", 12, -2.5)).actor)) == ["background"]


def test_relighting_is_a_gain_in_linear_light():
    dice = torch.Generator().manual_seed(0)
    colours = 0.1 + 0.6 * torch.rand(100, 3, generator=dice)
    rest = 0.02 * torch.randn(100, 3, 3, generator=dice)
    sh = torch.cat([sh_from_rgb(colours)[:, None], rest], 1)
    g = Gaussians(torch.zeros(100, 3), torch.ones(100, 4), torch.zeros(100, 3), torch.zeros(100), sh)
    gain = torch.tensor([1.4, 1.0, 0.6])
    for look in torch.nn.functional.normalize(torch.randn(5, 3, generator=dice), dim=1):
        before, after = (evaluate(x.sh, look.expand(100, 3)) for x in (g, relit(g, gain)))
        torch.testing.assert_close(after, srgb_from_linear(linear_from_srgb(before) * gain), atol=2e-3, rtol=0)
    torch.testing.assert_close(relit(g, torch.ones(3)).sh, g.sh, atol=2e-3, rtol=1e-3)


def test_an_asset_from_a_darker_bluer_place_comes_to_the_light_of_this_one(street):
    here = ground_linear(street, torch.tensor([12.0, 0.0]))
    assert here.tolist() == pytest.approx([linear_from_srgb(torch.tensor(0.32)).item()] * 3, rel=0.15)
    there = here * torch.tensor([0.4, 0.5, 0.7])
    away = replace(car(), gaussians=relit(car().gaussians, there / here), meta={"ground_linear": there.tolist()})
    back = insert(street, away, Placement("car", 12, 0)).actor.asset
    wanted, got = (rgb_from_sh(a.gaussians.sh[:, 0]) for a in (car(), back))
    assert float((wanted - got).abs().mean()) < 0.02
    assert back.meta["light_gain"] == pytest.approx([2.5, 2.0, 1.4286], rel=1e-3)
    assert matched(back, street, torch.tensor([12.0, 0.0])) is back, "it is in this light by now"


def test_an_asset_that_would_have_to_be_more_than_four_times_as_bright_says_so(street):
    here = ground_linear(street, torch.tensor([12.0, 0.0]))
    night = replace(car(), meta={"ground_linear": (here * torch.tensor([0.1, 0.5, 1.0])).tolist()})
    put_in = insert(street, night, Placement("car/0007", 12, 0))
    (said,) = [w for w in put_in.warnings if "as bright" in w]
    assert said.startswith("car/0007 should be 10, 2, 1 times as bright") and "the limit is 4 times" in said
    assert str(street.meta.get("name", "the scene")) in said
    assert put_in.actor.asset.meta["light_gain"] == pytest.approx([4.0, 2.0, 1.0], rel=1e-3)
    at_limit = replace(car(), meta={"ground_linear": (here * torch.tensor([0.26, 3.9, 1.0])).tolist()})
    calm = insert(street, at_limit, Placement("car/0007", 12, 0))
    assert not any("as bright" in w for w in calm.warnings) and "light_wanted" not in calm.actor.asset.meta


def test_an_asset_that_is_moved_from_light_to_light_is_four_times_as_bright_in_all(street):
    """And comes back as it was, though no databank holds it."""
    lamp = torch.tensor([2.0, 2.0, 2.0])
    lit = replace(street, background=replace(street.background, gaussians=relit(street.background.gaussians, lamp)))
    place = torch.tensor([12.0, 0.0])
    night = replace(car(), meta={"ground_linear": (ground_linear(street, place) * torch.tensor([0.1, 0.5, 1.0])).tolist()})
    once, straight = matched(night, street, place), matched(night, lit, place)
    assert straight.meta["light_gain"] == pytest.approx([4.0, 4.0, 2.0], rel=0.02) and straight.meta["light_wanted"][0] > 19
    for scene, as_if in ((lit, straight), (street, once), (lit, straight)):
        moved = matched(once, scene, place)
        assert moved.meta == as_if.meta
        torch.testing.assert_close(rgb_from_sh(moved.gaussians.sh), rgb_from_sh(as_if.gaussians.sh), atol=0.01, rtol=0)
        once = moved


def test_an_asset_whose_light_is_unknown_is_left_as_it_is(street):
    assert matched(car(), street, torch.tensor([12.0, 0.0])).gaussians is not None
    assert "light_gain" not in insert(street, car(), Placement("car", 12, 0)).actor.asset.meta
    lost = replace(street, background=Placed(Gaussians.empty(), street.background.world_from_local))
    known = replace(car(), meta={"ground_linear": [0.1, 0.1, 0.1]})
    assert matched(known, lost, torch.tensor([12.0, 0.0])) is known


@pytest.mark.parametrize(
    ("yaw_deg", "speed", "said"), [(90, 4.0, True), (-140, 4.0, True), (170, 4.0, False), (5, 4.0, False), (90, 0.0, False)]
)
def test_what_would_slide_along_a_lane_is_said(street, yaw_deg, speed, said):
    warnings = insert(street, car(), Placement("car", 12, 3, math.radians(yaw_deg), speed, "lane")).warnings
    assert any(f"car is turned by {yaw_deg}deg from the lane that it goes along, so it slides sideways" in w for w in warnings) == said


def test_oncoming_faces_the_other_way(street):
    pose = insert(street, car(), Placement("car", 12, 3, math.pi, 4.0, "lane")).actor.trajectory.at(START_US)
    assert abs(float(yaw_of(pose))) == pytest.approx(math.pi, abs=1e-3)


def test_standing_in_the_recording_cars_way_is_said(street):
    """It drives along x, 1 m a frame or so, and a car of 1.8 m has to stand 1.8 m beside its path."""
    last = street.ego.world_from_body[-1, :3, 3] - street.ego.world_from_body[0, :3, 3]
    half = float(last.norm()) / 2
    for left, said in ((0.0, True), (1.5, True), (2.2, False)):
        told = collisions(street, insert(street, car(), Placement("car", half, left)).actor)
        assert ("is where the recording car drives" in told.get("ego", "")) is said, left
