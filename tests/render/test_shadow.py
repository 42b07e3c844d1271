import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from street import START_US, box, car
from street import street as made_street

from recon.log import Track
from recon.seeds.shade import shade
from render import render_frame
from render.frame_types import Frame
from render.occlusion import shadow_box, squares, trace_field
from render.shadow import GRAZING, TILT, TURN, Shade, _light, cast, shadow_casters
from scenes import Actor, Camera, Equirectangular, Gaussians, Ground, OpenCV, Orthographic, Placed, Sky, Trajectory
from scenes.edit import Edit, edited
from scenes.formats.transform import moved
from scenes.hdr import load_hdr
from scenes.insert import insert
from scenes.light import disc, light_of
from scenes.placement import Placement
from scenes.poses import inverse, pose_from
from scenes.sky import linear_from_srgb, srgb_from_linear
from scenes.standing import standing_pose

CAR = car()
OVERCAST = light_of(replace(made_street(), sky=None)).directions.float()


def field(directions):
    return trace_field(CAR.gaussians, shadow_box(CAR.size, directions), directions, torch.ones(len(directions)))


def sun(elevation, yaw=0.0, radius=0.005):
    middle = torch.tensor([math.cos(elevation) * math.cos(yaw), math.cos(elevation) * math.sin(yaw), math.sin(elevation)])
    return disc(middle.double(), radius, 32).float()


def at(field, x, y, z=0.0) -> float:
    where = 2 * (torch.tensor([x, y, z]) - field.box.low) / (field.box.high - field.box.low) - 1
    found = torch.nn.functional.grid_sample(field.blocked[None, None], where.view(1, 1, 1, 1, 3), align_corners=True, padding_mode="zeros")
    return float(found)


def test_under_a_closed_sky_it_is_darkest_below_the_asset_and_light_again_beside_it():
    shade = field(OVERCAST)
    assert at(shade, 0, 0) > 0.85 > at(shade, 2.3, 0) > at(shade, 2.7, 0) > at(shade, 3.2, 0)
    assert at(shade, 6.2, 0) < 0.01 and at(shade, 6.6, 0) == 0
    for x, y in ((0.0, 1.2), (2.4, 0.0), (2.3, 1.1)):
        assert at(shade, x, y) == pytest.approx(at(shade, -x, y), abs=0.06)
        assert at(shade, x, y) == pytest.approx(at(shade, x, -y), abs=0.06)


def test_the_suns_shadow_is_as_long_as_the_asset_is_high_over_the_tangent():
    for elevation, yaw in ((0.3, 0.0), (0.6, 2.0), (0.4, -1.2)):
        shade = field(sun(elevation, yaw))
        away = -torch.tensor([math.cos(yaw), math.sin(yaw)])
        # from the edge of the footprint that the shadow leaves by, along its way
        start = (CAR.size[:2].float() / 2 / away.abs().clamp_min(1e-6)).min() * away
        length = 1.5 / math.tan(elevation)
        inside, outside = start + 0.75 * length * away, start + 1.25 * length * away
        assert at(shade, *inside.tolist()) > 0.9 and at(shade, *outside.tolist()) < 0.1, (elevation, yaw)
        assert at(shade, *(-inside).tolist()) < 0.1  # none towards the sun


def test_the_tip_of_a_shadow_is_as_dark_as_the_rest_of_it():
    tip = -(2.1 + 1.5 / math.tan(0.4))
    assert at(field(sun(0.4)), tip + 0.15, 0) > 0.9


def test_the_slanted_side_of_a_shadow_has_no_stairs():
    shade, ahead = field(sun(0.4, 0.5)), torch.tensor([math.cos(0.5), math.sin(0.5)])
    beside = torch.tensor([-ahead[1], ahead[0]])
    along = [torch.tensor([-2.1, 0.9]) - d * ahead for d in torch.linspace(0.5, 2.5, 41)]
    rows = [[at(shade, *(p + off * beside).tolist()) for p in along] for off in torch.linspace(-0.1, 0.3, 41)]
    edge = min(rows, key=lambda row: abs(sum(row) / len(row) - 0.5))
    assert max(edge) - min(edge) < 0.5  # 1 between cells that are lit or not


def on_slope(street, rise: float):
    """The open street, climbing by so many metres a metre along x, under a sun 30 degrees high that stands ahead: its caster and light."""
    pose, g = torch.eye(4, dtype=torch.float64), open_street(street).background.gaussians
    pose[:3, :3] = torch.tensor([[1, 0, -rise], [0, (1 + rise**2) ** 0.5, 0], [rise, 0, 1]], dtype=torch.float64) / (1 + rise**2) ** 0.5
    ground = replace(street.ground, heights=(rise * (torch.arange(60) - 10.0)).expand(40, 60).contiguous())
    sky = torch.full((36, 72, 3), 0.1)
    sky[11, 35:37] = 60000.0  # 32.5 degrees high
    scene = replace(street, actors=(), background=Placed(g, pose), ground=ground, sky=Sky(sky))
    scene = insert(scene, CAR, Placement("car", 12, 0)).scene
    (caster,) = shadow_casters(scene, scene.camera("front_camera", START_US))
    return caster.field()


def test_a_shadow_on_a_slope_is_as_long_as_the_sun_stands_high_over_the_slope(street):
    for rise in (0.0, 0.15, -0.15):
        length = 1.5 / math.tan(math.radians(32.5) - math.atan(rise))  # the slope climbs towards the sun
        shade = on_slope(street, rise)
        assert at(shade, -2.1 - 0.85 * length, 0) > 0.8 and at(shade, -2.1 - 1.15 * length, 0) < 0.2, rise


def test_a_slope_gets_more_of_the_light_that_it_faces(street):
    """As much of each direction's light as on level ground, but for how steeply it falls onto the slope."""
    ground = replace(street.ground, heights=(0.15 * torch.arange(60.0)).expand(40, 60).contiguous())
    result = insert(replace(open_street(street), sky=None, ground=ground), CAR, Placement("car", 12, 0))
    shade, normal = Shade(result.scene), torch.tensor([-0.15, 0.0, 1.0], dtype=torch.float64) / (1 + 0.15**2) ** 0.5
    local, weights = shade.at(result.actor, START_US)
    world = shade.light.directions
    wanted = (world @ normal).clamp_min(0) / world[:, 2].clamp_min(GRAZING)
    assert wanted.min() < 0.8 and wanted.max() > 1.2
    torch.testing.assert_close(weights.double(), wanted, atol=0.06, rtol=0)  # the slope is told in steps of 1.5 degrees
    torch.testing.assert_close(local[:, 2].double(), world @ normal, atol=0.01, rtol=0)


def test_a_shadow_climbs_what_stands_in_it():
    shade = field(sun(0.4))
    x = -2.1 - 0.5 * 1.5 / math.tan(0.4)  # half-way along the shadow the ray that grazes the roof is half as high
    assert at(shade, x, 0, 0.5) > 0.9 and at(shade, x, 0, 1.2) < 0.3


def test_a_wide_light_makes_a_soft_edge():
    length = 2.1 + 1.5 / math.tan(0.5)
    places = [-length + d for d in (-0.4, -0.2, 0, 0.2, 0.4)]
    sharp, soft = field(sun(0.5)), field(sun(0.5, radius=0.15))
    steepest = [max(b - a for a, b in zip(v, v[1:], strict=False)) for v in ([at(f, x, 0) for x in places] for f in (sharp, soft))]
    assert steepest[0] > 1.5 * steepest[1]


def test_a_sunset_casts_a_long_soft_shadow_away_from_the_sun(street, shared):
    sky = Sky(load_hdr(shared / "envmaps" / "venice_sunset_1k.hdr"))
    scene = insert(replace(street, sky=sky, actors=()), CAR, Placement("car", 12, 0)).scene
    light = light_of(scene)
    shade = field(light.directions.float())
    away = -torch.nn.functional.normalize(light.sun[:2].float(), dim=0)
    across = torch.stack([-away[1], away[0]])
    for far in (3.0, 4.0, 5.0):  # as far again as the car is long
        there = at(shade, *(far * away).tolist())
        others = [at(shade, *(far * d).tolist()) for d in (-away, across, -across)]
        assert there > 0.05 and there > 2 * max(others), (far, there, others)
    profile = [at(shade, *(d * away).tolist()) for d in torch.linspace(2.5, 7, 10)]
    assert max(abs(a - b) for a, b in zip(profile, profile[1:], strict=False)) < 0.25  # no hard edge


def open_street(street):
    """The street without houses."""
    g = street.background.gaussians
    return replace(street, background=Placed(g.select(g.means[:, 2] < 0.1), street.background.world_from_local))


@pytest.mark.parametrize("turn", [0.0, math.pi / 4])
def test_houses_keep_the_sun_off(street, turn):
    """However the frame is turned in which their splats are."""
    pose = pose_from([math.cos(turn / 2), 0, 0, math.sin(turn / 2)], [0, 0, 0])
    street = replace(street, background=Placed(moved(street.background.gaussians, inverse(pose), Path("street")), pose))
    high = torch.full((32, 64, 3), 0.1)
    high[13, 14] = 2000.0  # 17 degrees high, to the left of the street (+y)
    for scene, least, most in ((open_street(street), 0.7, 1.0), (street, 0.0, 0.4)):
        scene = insert(replace(scene, sky=Sky(high)), CAR, Placement("car", 12, 0)).scene
        caster = shadow_casters(scene, scene.camera("front_camera", START_US))[0]
        assert least <= at(caster.field(), 0.0, -2.2) <= most


def test_a_roof_keeps_light_off_a_turned_asset_where_its_end_reaches(street):
    """And not where that would be if it were turned the other way."""
    bare, reaches = replace(open_street(street), sky=None, actors=()), 5 * math.sqrt(0.5)
    long = replace(CAR, size=torch.tensor([10.0, 1.0, 1.5], dtype=torch.float64))
    result = insert(bare, long, Placement("truck", 12, 0, yaw=math.pi / 4))
    light, (x, y) = {}, result.actor.trajectory.world_from_body[0, :2, 3].tolist()
    for side in (-1, 1):
        roof = box((3.0, 3.0, 0.2), (0.5, 0.5, 0.5))
        roof = replace(roof, means=roof.means + torch.tensor([x + reaches, y + side * reaches, 2.5]))
        g = Gaussians.cat([bare.background.gaussians, roof])
        scene = replace(result.scene, background=replace(bare.background, gaussians=g))
        light[side] = float(Shade(scene).at(result.actor, START_US)[1].sum())
    assert light[1] < 0.9 * light[-1]


def test_only_what_the_light_would_reach_is_darkened(street):
    """A pixel that sees the ground, a kerb, something higher than the car, the car itself, and nothing at all."""
    camera = street.camera("front_camera", START_US)
    scene = insert(replace(open_street(street), sky=None), CAR, Placement("car", 9, 0)).scene
    (caster,) = shadow_casters(scene, camera)
    y, x = 40, 48  # 6 m ahead of the camera, under the car
    down = (y + 0.5 - 27) / 57.6
    depths = {"ground": 1.5 / down, "kerb": 1.35 / down, "roof": 0.0, "nothing": float("inf"), "door": 0.9 / down}
    light = {}
    for name, depth in depths.items():
        flat = torch.full((54, 96), depth)
        instance = torch.full((54, 96), 2 if name == "door" else 0, dtype=torch.int32)
        light[name] = float(cast(Frame(camera, rgb=torch.ones(54, 96, 3), depth=flat, instance=instance), [caster])[y, x, 0])
    assert light["ground"] == pytest.approx(light["kerb"])
    assert light["ground"] < 0.7
    assert light["roof"] == light["nothing"] == light["door"] == 1


def test_a_shadow_has_no_edge_where_the_asset_begins_to_hide_the_ground(street):
    """Through the rim of an asset the ground shows, in shadow: as much as it is seen, whichever of both is more."""
    camera = street.camera("front_camera", START_US)
    scene = insert(replace(open_street(street), sky=None), CAR, Placement("car", 9, 0)).scene
    (caster,) = shadow_casters(scene, camera)
    depth, light = torch.full((54, 96), 1.22 * 57.6 / 13.5), {}  # 0.28 m above the ground
    for share in (0.0, 0.49, 0.51, 1.0):
        instance = torch.full((54, 96), caster.instance if share > 0.5 else 0, dtype=torch.int32)
        frame = Frame(camera, rgb=torch.full((54, 96, 3), 0.5), depth=depth, instance=instance)
        light[share] = cast(frame, [caster], torch.full((54, 96, 1), share))[40, 48, 0]
    assert light[1.0] == 0.5 > light[0.51] + 0.05
    assert light[0.51] - light[0.49] < 0.02
    assert light[0.0] < light[0.49] - 0.05


def test_what_shows_through_an_asset_stands_in_its_shadow(street):
    low = CAR.gaussians.means[:, 2] < 1.1  # a roof on thin air
    thin = replace(CAR, gaussians=replace(CAR.gaussians, logit_opacities=torch.where(low, -2.5, CAR.gaussians.logit_opacities)))
    scene = insert(replace(open_street(street), sky=None), thin, Placement("car", 9, 0)).scene
    camera = scene.camera("front_camera", START_US)
    lit, shaded = (render_frame(scene, camera, shadows=on).rgb[37:40, 44:52] for on in (False, True))
    assert (shaded < 0.85 * lit).all()


def test_assets_out_of_view_cost_nothing(street):
    camera = street.camera("front_camera", START_US)
    street = replace(street, sky=None)
    assert shadow_casters(insert(street, CAR, Placement("car", -12, 0)).scene, camera) == []
    (caster,) = shadow_casters(insert(street, CAR, Placement("car", 14, 0)).scene, camera)
    x0, y0, x1, y1 = caster.window
    assert 0 <= x0 < 48 < x1 <= 96 and 20 < y1 <= 54
    assert (x1 - x0) * (y1 - y0) < 96 * 54 / 4


def test_an_asset_that_is_not_there_yet_casts_no_shadow(street):
    scene = insert(street, CAR, Placement("car", 14, 0, speed=5.0)).scene
    new, camera = scene.actors[-1], street.camera("front_camera", START_US)
    later = replace(new, trajectory=replace(new.trajectory, times_us=new.trajectory.times_us + 10_000_000))
    assert len(shadow_casters(scene, camera)) == 1
    assert shadow_casters(replace(scene, actors=(*scene.actors[:-1], later)), camera) == []


def test_an_asset_across_the_camera_plane_may_shade_the_whole_image(street):
    beside = insert(street, CAR, Placement("car", 1.5, 2.5)).scene
    (caster,) = shadow_casters(beside, street.camera("front_camera", START_US))
    assert caster.window == (0, 0, 96, 54)


def test_a_clip_traces_a_standing_assets_shadow_once(street, monkeypatch):
    import render.shadow

    calls = []
    traced = render.shadow.trace_field
    monkeypatch.setattr(render.shadow, "trace_field", lambda *a: calls.append(1) or traced(*a))
    scene = insert(street, CAR, Placement("car", 10, 0)).scene
    for t in scene.frame_times("front_camera")[:4]:
        render_frame(scene, scene.camera("front_camera", int(t)))
    assert len(calls) == 1


@pytest.mark.parametrize(("k1", "x", "y"), [(-0.06, 8, 3.5), (-0.1, 8, 6)])
def test_a_shadow_falls_within_its_window_though_the_lens_folds_over(street, k1, x, y):
    scene = insert(replace(open_street(street), sky=None), CAR, Placement("car", x, y)).scene
    lens = OpenCV(65.0, 65.0, 80.0, 50.0, k1, 0.0)
    camera = Camera(lens, 160, 100, scene.camera("front_camera", START_US).world_from_cam, time_us=START_US)
    (caster,) = shadow_casters(scene, camera)
    box = caster.field().box
    places = torch.cartesian_prod(*(torch.linspace(float(a), float(b), 15) for a, b in zip(box.low, box.high, strict=True))).double()
    seen = places @ inverse(caster.asset_from_cam[0])[:3, :3].T + inverse(caster.asset_from_cam[0])[:3, 3]
    pixels = lens.project(seen[lens.valid(seen)])
    pixels = pixels[((pixels > 0) & (pixels < torch.tensor([160, 100]))).all(1)]
    x0, y0, x1, y1 = caster.window
    assert len(pixels) and (pixels >= torch.tensor([x0, y0])).all() and (pixels <= torch.tensor([x1, y1])).all()


def on_ground(camera) -> Frame:
    """A frame that shows nothing but the ground: its depth is that of something below it, and a ray to the ground is followed there."""
    height, width = camera.height, camera.width
    far = torch.full((height, width), 1000.0)
    return Frame(camera, rgb=torch.ones(height, width, 3), depth=far, instance=torch.zeros(height, width, dtype=torch.int32))


def test_a_panorama_shows_the_shadow_behind_it(street):
    scene = insert(replace(open_street(street), sky=None), CAR, Placement("car", -6, 2)).scene
    ahead, turned = scene.camera("front_camera", START_US).world_from_cam, torch.diag(torch.tensor([-1.0, 1, -1, 1], dtype=torch.float64))
    light = []
    for pose in (ahead, ahead @ turned):
        camera = Camera(Equirectangular.whole(64, 32), 64, 32, pose, time_us=START_US)
        light.append(cast(on_ground(camera), shadow_casters(scene, camera))[..., 0])
    assert light[0].min() < 0.7
    torch.testing.assert_close(light[0], light[1].roll(32, 1), atol=1e-4, rtol=0)


def test_parallel_rays_show_a_shadow_where_it_lies(street):
    scene = insert(replace(open_street(street), sky=None), CAR, Placement("car", 12, 0)).scene
    down = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    down[:3, 3] = torch.tensor([9.0, 2.0, 12.0])  # 3 m behind the car, 2 m to its left
    camera = Camera(Orthographic(8.0, 8.0, 64.0, 64.0), 128, 128, down, time_us=START_US)
    dark = 1 - cast(on_ground(camera), shadow_casters(scene, camera))[..., 0]
    y, x = ((dark * camera.pixel_centres()[..., k]).sum() / dark.sum() for k in (1, 0))
    assert (float(x), float(y)) == pytest.approx((64 + 3 * 8, 64 + 2 * 8), abs=0.5)


@pytest.mark.parametrize("heading", [90, 144])
def test_a_turned_asset_casts_the_shade_of_its_turned_shape(street, heading):
    """As one that was built turned: a board that is a few flat splats, near one corner of its footprint, under a low sun."""
    half, low = math.radians(heading) / 2, torch.full((32, 64, 3), 0.1)
    low[12, 20] = 2000.0  # 20 degrees high
    bare = replace(open_street(street), sky=Sky(low), actors=())
    n = 4
    board = Gaussians(
        torch.stack([torch.linspace(0.0, 1.5, n), torch.full((n,), 1.2), torch.full((n,), 0.9)], 1),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.tensor([0.4, 0.01, 0.5]).log().repeat(n, 1),
        torch.full((n,), 4.0),
        torch.zeros(n, 1, 3),
    )
    asset = replace(CAR, gaussians=board, size=torch.tensor([4.0, 4.0, 1.5], dtype=torch.float64))
    built = replace(asset, gaussians=moved(board, pose_from([math.cos(half), 0, 0, math.sin(half)], [0, 0, 0]), Path("board")))
    down = torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
    down[:3, 3] = torch.tensor([12.0, 0.0, 12.0])
    camera, light = Camera(Orthographic(8.0, 8.0, 64.0, 64.0), 128, 128, down, time_us=START_US), []
    for one, angle in ((built, 0.0), (asset, 2 * half), (asset, 0.0)):
        scene = insert(bare, one, Placement("board", 12, 0, yaw=angle)).scene
        light.append(cast(on_ground(camera), shadow_casters(scene, camera))[..., 0])
    as_built, turned, unturned = light
    assert as_built.min() < 0.6
    assert (turned - as_built).abs().mean() < 0.1 * (unturned - as_built).abs().mean()


@pytest.mark.parametrize("shutter", ["rows", "columns"])
def test_a_shadow_stays_below_its_asset_while_the_shutter_moves(street, shutter):
    ahead = insert(replace(open_street(street), sky=None), CAR, Placement("car", 9, -1, yaw=math.pi / 2, speed=15.0)).scene
    readout = 60_000
    rolling = replace(ahead.rig["front_camera"], shutter=shutter, readout_us=readout)
    camera = replace(ahead, rig={"front_camera": rolling}).camera("front_camera", START_US)
    light = cast(on_ground(camera), shadow_casters(ahead, camera))[..., 0]
    lines, still = (54, light) if shutter == "rows" else (96, light.T)
    for line in range(24, 96, 9) if shutter == "columns" else range(30, 54, 6):
        now = ahead.rig["front_camera"].along(ahead.ego, START_US + round(readout * (line + 0.5) / lines))
        there = cast(on_ground(now), shadow_casters(ahead, now))[..., 0]
        torch.testing.assert_close(still[line], (there if shutter == "rows" else there.T)[line], atol=0.02, rtol=0)
    assert light.min() < 0.7


def test_what_houses_keep_off_does_not_depend_on_the_frames_before(street):
    scene = insert(street, CAR, Placement("car", 2, 3, speed=20.0)).scene
    car_there, times = scene.actors[-1], scene.frame_times("front_camera").tolist()
    onward, backward = Shade(scene), Shade(scene)
    ahead = [onward.at(car_there, t)[1] for t in times]
    behind = [backward.at(car_there, t)[1] for t in reversed(times)]
    assert len({tuple(v.tolist()) for v in ahead}) > 1
    assert all(torch.equal(a, b) for a, b in zip(ahead, reversed(behind), strict=True))


def test_an_actor_that_brought_its_shade_along_casts_no_second_shadow(street):
    (actor,) = street.actors
    poses, times = actor.trajectory.world_from_body, actor.trajectory.times_us.numpy()
    laid = shade(Track("veh_1", "car", True, actor.asset.size.numpy(), times, poses, np.full(len(times), -1), ()), street.ground, 1)
    half = replace(laid, sh=laid.sh.half().float())  # as files of half precision hold it
    asset = replace(actor.asset, gaussians=Gaussians.cat([actor.asset.gaussians, half]))
    scene, bare = replace(street, actors=(replace(actor, asset=asset),)), street

    def casters(scene, **edit):
        return len(shadow_casters(edited(scene, Edit(**edit)), street.camera("front_camera", START_US)))

    moved = {"shift": {"veh_1": (0.0, 0.5)}}
    assert casters(bare, **moved) == 1 and casters(scene, **moved) == 0
    assert casters(scene, **moved, replace={"veh_1": CAR}) == 1, "its shade went with it"


@pytest.mark.parametrize("heading", [0.0, 1.6, -2.5])
def test_light_comes_from_where_it_does_in_the_frame_of_what_stands_on_a_slope(street, heading):
    along = torch.arange(60.0)[None].expand(40, -1).contiguous()
    hill = replace(street, ground=Ground(0.2 * along, (-10.0, -20.0), 1.0))
    pose = standing_pose(hill, torch.tensor([9.0, 1.0], dtype=torch.float64), heading, car().size)
    of_hill = Shade(hill)
    directions, _ = of_hill.at(Actor(car(), Trajectory(torch.tensor([0]), pose[None]), "new"), 0)
    there = (of_hill.light.directions @ pose[:3, :3]).float()
    assert (directions * there).sum(1).min() > math.cos(TURN + TILT)


@pytest.mark.parametrize("bright", [0.3, 0.8])
def test_light_is_taken_away_in_linear_light(street, bright):
    scene = insert(street, car(), Placement("car/0001", 9.0, 1.0)).scene
    camera = scene.camera("front_camera", START_US)
    frame = render_frame(scene, camera, ("rgb", "depth", "instance"))
    frame = replace(frame, rgb=torch.full_like(frame.rgb, bright))
    (caster,) = shadow_casters(scene, camera)
    x0, y0, x1, y1 = caster.window
    light = _light(frame, caster, (frame.instance == caster.instance).float())
    assert light.min() < 0.5
    expected = srgb_from_linear(linear_from_srgb(torch.tensor(bright)) * light)[..., None].expand(-1, -1, 3)
    torch.testing.assert_close(cast(frame, [caster])[y0:y1, x0:x1], expected, atol=1e-5, rtol=0)


def test_fewer_splats_block_as_much_light(monkeypatch):
    """Of more than can be traced every few, in squares as much larger."""

    def area() -> float:
        a, b, c = torch.from_numpy(squares(CAR.gaussians)).unbind(1)
        return float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum())

    whole = area()
    monkeypatch.setattr("render.occlusion.MOST", len(CAR.gaussians) // 4)
    assert area() == pytest.approx(whole, rel=0.05)
