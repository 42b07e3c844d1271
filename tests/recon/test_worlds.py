"""Made-up places: what a camera and a lidar see of a box and of someone who passes, and what the bench makes of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from render.rays import world_directions
from scenes.poses import inverse
from scenes.sky import linear_from_srgb
from tests.bench.worlds.place import UNSEEN, Light, Mover, Part, Place, along, fisheye, gone, looking
from tests.bench.worlds.record import LOOKS, looks, recorded
from tests.bench.worlds.room import room
from tests.bench.worlds.sensor import Sensor, lit, taken
from tests.bench.worlds.slopes import over, strip
from tests.bench.worlds.solids import box, joined, panel, plain
from tests.bench.worlds.town import KERB, Street, town
from tests.bench.worlds.underpass import DEEP, DIP, height

TIMES = 1_700_000_000_000_000 + 100_000 * torch.arange(6)
SUN = (0.0, -0.6, 0.8)


@pytest.fixture
def place() -> Place:
    """A grey plain with a red box 10 m ahead, which casts its shadow to the left, and a blue one that crosses 6 m ahead."""
    ground = panel((-50, -50, 0), (100, 0, 0), (0, 100, 0), plain((0.5, 0.5, 0.5)))
    crosses = along([(6.0, -1.5), (6.0, -0.5)], 2.0, TIMES)
    return Place(
        "plain",
        joined([ground, box((10.5, 0, 0), (1, 2, 2), plain((0.8, 0.1, 0.1)))]),
        (Mover("blue", "car", (0.5, 0.5, 0.5), (Part(box((0, 0, 0), (0.5, 0.5, 0.5), plain((0.1, 0.1, 0.8)))),), crosses),),
        Light(SUN, (0.8, 0.8, 0.8), (0.2, 0.2, 0.2), 5.0),
        along([(0.0, 0.0), (10.0, 0.0)], 1.0, TIMES),
        {"front": looking((64, 48), 90.0, 0.0, (0.0, 0.0, 1.0), TIMES[:-1])},
        ((-10.0, 0.0, 5.0), (0.0, 0.0, 1.5)),
        ((0.0, 0.0), (1.0, 0.0)),
    )


def test_a_noisy_camera_gets_less_light_and_the_truth_no_noise(place, tmp_path):
    log = recorded(place, ["front"], tmp_path)
    sensor = Sensor(0.25, 1e-4, 1e-3, None)
    _, _, truth = next(looks(place, "front", tmp_path, [0]))
    dim = lit(truth, sensor)
    noisy = torch.from_numpy(taken(log, sensor, tmp_path / "night").camera("front").image(0).copy()) / 255
    assert torch.allclose(dim.rgb**2.2, 0.25 * truth.rgb**2.2, atol=1e-6) and torch.equal(dim.depth, truth.depth)
    off = (noisy**2.2 - dim.rgb**2.2)[dim.rgb.amin(-1) > 0.2]
    assert abs(float(off.mean())) < 2e-3 and 0.01 < float(off.std()) < 0.02


def pixel(camera, point) -> tuple[int, int]:
    """Row and column of a world point."""
    x, y, z = (inverse(camera.world_from_cam) @ torch.tensor([*point, 1.0], dtype=torch.float64))[:3].tolist()
    return int(camera.lens.fy * y / z + camera.lens.cy), int(camera.lens.fx * x / z + camera.lens.cx)


def test_a_camera_sees_colours_depths_and_who_is_there(place):
    camera = place.rig["front"].along(place.ego, int(TIMES[0]))
    rgb, depth, who = place.seen(camera)
    at = pixel(camera, (10.0, 0.5, 1.0))
    assert depth[at] == pytest.approx(10.0, abs=1e-3) and who[at] == 0
    assert rgb[at][0] > 2 * rgb[at][2]
    assert who[0, 0] == -1 and depth[0, 0].isinf()
    mover = pixel(camera, (5.75, -1.5, 0.25))
    assert who[mover] == 1 and rgb[mover][2] > 2 * rgb[mover][0] and depth[mover] == pytest.approx(5.75, abs=1e-3)


def test_the_sun_casts_shadows_away_from_itself(place):
    camera = place.rig["front"].along(place.ego, int(TIMES[0])).resized(256, 192)
    rgb, *_ = place.seen(camera)
    shade, sunny = (rgb[pixel(camera, (10.5, side * 1.6, 0.0))].mean() for side in (1, -1))
    assert shade < 0.7 * sunny


def test_rows_are_read_one_after_the_other(place):
    """Each row is that of a camera which takes all at once at the row's moment: of what stands still to a hundredth of a pixel."""
    rig = replace(place.rig["front"], shutter="rows", readout_us=90_000)
    _, depth, who = place.seen(rig.along(place.ego, int(TIMES[0])))
    for row in (4, 30, 34, 47):
        at = int(TIMES[0]) + round((row + 0.5) / 48 * 90_000)
        _, then, there = place.seen(rig.at(place.ego.at(at), at))
        assert (who[row] == there[row]).float().mean() > 0.98, "movers stand still for a millisecond"
        still = (who[row] == 0) & (there[row] == 0)
        assert torch.allclose(depth[row][still], then[row][still], atol=2e-3)
    assert (who == 1).any()


def test_a_drive_read_row_by_row_has_poses_of_the_middle_row(place, tmp_path):
    rig = replace(place.rig["front"], shutter="rows", readout_us=20_000)
    camera = recorded(replace(place, rig={"front": rig}), ["front"], tmp_path).camera("front")
    assert camera.times_us.tolist() == (TIMES[:-1] + 10_000).tolist() and (camera.shutter, camera.readout_us) == ("rows", 20_000)
    assert camera.world_from_cam[2, 0, 3] == pytest.approx(0.21)
    truth = next(iter(looks(replace(place, rig={"front": rig}), "front", tmp_path, [2])))[2]
    at_once = place.rig["front"].at(place.ego.at(int(TIMES[2]) + 10_000), int(TIMES[2]) + 10_000)
    assert torch.equal(truth.depth, place.seen(at_once)[1]), "as scenes' cameras take it"


def test_a_fisheye_shows_a_circle(place):
    camera = fisheye((64, 48), 200.0, (0.0, 0.0, 1.0), TIMES[:-1]).along(place.ego, int(TIMES[0]))
    rgb, depth, who = place.seen(camera)
    assert (who[0, 0], who[24, 0], who[24, 63]) == (UNSEEN, UNSEEN, UNSEEN) and not rgb[who == UNSEEN].any()
    assert depth[24, 32] == pytest.approx(10.0, abs=0.02)
    row = 24 + int(64 * 45 / 200)  # down by 45 degrees, 1 m above the ground
    assert who[row, 32] == 0 and depth[row, 32] == pytest.approx(2**0.5, rel=0.03)


def test_limbs_swing_about_their_joint():
    part = Part(box((0, 0, 0), (0.1, 0.1, 1), plain((1, 1, 1))), (0.0, 0.0, 1.0), 0.5, 1.0)
    pose = part.in_box(0.25)
    assert torch.allclose(pose @ torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0, 1.0]).double())
    assert float((pose @ torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=torch.float64))[0].abs()) == pytest.approx(np.sin(0.5))


def test_a_drive_reads_as_the_place_is(place, tmp_path):
    log = recorded(place, ["front"], tmp_path)
    image = log.camera("front").image(2)
    assert np.abs(image / 255 - place.seen(log.camera("front").camera(2))[0].numpy()).max() < 0.5 / 255 + 1e-6
    points = log.sweeps[3].read()
    assert np.array_equal(log.sweeps[3].read().xyz, points.xyz), "kept, not traced anew"
    assert len(np.unique(points.times_us)) > 10
    box_from_world = inverse(place.movers[0].trajectory.near(int(points.times_us[0]))).numpy()
    own = points.xyz @ box_from_world[:3, :3].T + box_from_world[:3, 3]
    on_mover = (np.abs(own[:, :2]) < 0.5).all(1) & (own[:, 2] > 0.05) & (own[:, 2] < 0.6)
    on_ground, on_box = np.abs(points.xyz[:, 2]) < 0.1, np.abs(points.xyz - [10.5, 0, 1]).max(1) < 1.15
    assert (on_ground | on_box | on_mover).all() and on_box.any()
    assert [t.name for t in log.tracks] == ["veh_1"]


def test_truth_beside_the_path_is_seen_from_beside_the_path(place, tmp_path):
    found = list(looks(place, "front", tmp_path, [1, 3]))
    assert [(aside, i) for aside, i, _ in found] == [((0.0, 0.0), 1), ((0.0, 0.0), 3), ((1.0, 0.0), 1), ((1.0, 0.0), 3)]
    truth = found[2][2]
    camera = place.rig["front"].along(place.ego.shifted(lateral=1.0), int(TIMES[1]))
    assert torch.equal(truth.depth, place.seen(camera)[1])
    again = next(iter(looks(replace(place, movers=()), "front", tmp_path, [1])))[2]
    assert (again.who == 1).any(), "kept, not traced anew"
    assert LOOKS > 1


def test_the_room_is_closed_but_for_its_windows():
    """No ray through a gap between walls, ceiling and floor: all that is seen of the sky is above a window's sill."""
    place = room(people=False)
    for name in place.rig:
        camera = place.rig[name].along(place.ego, int(place.rig[name].times_us[30]))
        pose = camera.world_from_cam.float()
        rays = torch.nn.functional.normalize(world_directions(camera).reshape(-1, 3)[::7], dim=1)
        metres, who = place.distances(pose[:3, 3].expand(len(rays), 3), rays, camera.time_us)
        sky = rays[who < 0]
        assert (sky[:, 1] > 0).all(), "windows are to the left"
        assert len(sky) < 0.1 * len(rays) and metres[who == 0].max() < 60


def test_a_picture_is_as_bright_as_it_is_exposed_long(place):
    camera = place.rig["front"].along(place.ego, int(TIMES[2]))
    usual = linear_from_srgb(place.seen(camera)[0])
    later = replace(place, stops=np.array([TIMES[[1, 3]].numpy(), [0.0, 1.0]]))
    longer = linear_from_srgb(later.seen(camera)[0])
    dim = (usual > 0.01) & (usual < 0.6)
    assert torch.allclose(longer[dim], 2**0.5 * usual[dim], rtol=1e-3), "halfway between its moments, half a stop"


def test_where_hardly_anything_is_open_some_light_comes_all_the_same(place):
    roof = panel((-40, 40, 2.5), (80, 0, 0), (0, -80, 0), plain((0.5, 0.5, 0.5)))
    under = replace(place, still=joined([place.still, roof]))
    camera = place.rig["front"].along(place.ego, int(TIMES[0]))
    dark, lit = (
        replace(under, light=replace(place.light, reach=100.0, bounced=bounced)).seen(camera)[0][40, 32].mean() for bounced in (0.0, 0.2)
    )
    assert lit > dark + 0.02


def test_who_waits_stands_and_faces_where_he_goes():
    path = gone([(0.0, 0.0), (0.0, 10.0)], np.array([0.0, 1.0, 2.0, 2.0, 2.0, 3.0]), TIMES)
    assert path.world_from_body[:, 1, 3].tolist() == [0.0, 1.0, 2.0, 2.0, 2.0, 3.0]
    assert torch.allclose(path.world_from_body[:, 1, 0], torch.ones(6, dtype=torch.float64))


def test_what_drives_into_a_dip_goes_down_and_up_with_it():
    middle = sum(DIP) / 2
    path = over(along([(DIP[0] + 10.0, 0.0), (200.0, 0.0)], 100.0, TIMES), height)
    places = path.world_from_body[:, :3, 3]
    assert np.allclose(places[:, 2].numpy(), height(places[:, 0].numpy())) and height(np.array(middle)) == -DEEP
    ahead = path.world_from_body[:, :3, 0]
    assert ahead[0, 2] < -0.1 and ahead[-1, 2] > 0.05, "it looks down into it, and up out of it"
    assert float(path.world_from_body[0, :3, 2] @ ahead[0]) == pytest.approx(0, abs=1e-12)


def test_a_strip_follows_its_way_over_the_ground():
    angle = np.linspace(0, 1.0, 40)
    way = 30 * np.stack([np.sin(angle), 1 - np.cos(angle)], 1)
    band = strip(way, ((-2.0, 0.1), (3.0, 0.1)), plain((1, 1, 1)), 1.0, lambda x: 0.05 * x)
    radii = np.linalg.norm(band.vertices[:, :2] - [0, 30.0], axis=1)
    assert set(radii.round(1)) == {32.0, 27.0}, "2 m to the right of it, which is the outside, and 3 m to the left"
    assert np.allclose(band.vertices[:, 2], 0.1 + 0.05 * band.vertices[:, 0], atol=1e-5)
    assert (band.normals @ np.array([-0.05, 0, 1]) > 0.999).all(), "it looks up from the slope"


@pytest.mark.parametrize("seed", range(6))
def test_in_any_town_wheels_and_feet_are_on_the_ground(shared, seed):
    """Whoever moves, and the recorder, stands on the road or the pavement, upright from it, within a kerb's height."""
    place = town(shared / "meshes", seed)
    down = torch.tensor([[0.0, 0.0, -1.0]])
    for path in (place.ego, *(m.trajectory for m in place.movers)):
        for pose in path.world_from_body[::20]:
            x, y, z = pose[:3, 3].tolist()
            metres, who = replace(place, movers=()).distances(torch.tensor([[x, y, z + 0.4]]), down, int(path.times_us[0]))
            assert who.item() == 0 and metres.item() - 0.4 == pytest.approx(0, abs=KERB + 0.03)
            assert float(place.level(torch.tensor([x]), torch.tensor([y]))) == pytest.approx(z, abs=1e-5)
    assert np.array_equal(town(shared / "meshes", seed).still.vertices, place.still.vertices)


def test_streets_by_lot_are_told_along_their_way():
    street = Street.by_lot(np.random.default_rng(3))
    here, there = street.at(10.0, 0.0), street.at(12.0, 1.5)
    assert torch.allclose((inverse(here) @ there)[:3, 3], torch.tensor([2.0, 1.5, 0.0]).double(), atol=0.15)
    assert len(street.points(10.0, 2.0, 1.0)) == 9
