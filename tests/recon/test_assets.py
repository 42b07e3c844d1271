import io
import math
from collections import Counter
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from street import START_US, box, car, rig

from recon import extract_assets
from recon.assets.extract import candidates, completed, moved, silhouette, thumbnail, turned
from recon.assets.looking import looking_at
from recon.assets.photos import _views, photos_of
from recon.assets.sight import Views, sight_of
from recon.objects.mirror import within_box
from render import rasterize, render_frame
from render.album import keep_photos
from render.rays import camera_rays
from render.references import Shot
from render.video import from_bytes, to_bytes
from scenes import Asset, Databank, Gaussians, Pinhole, Placed, Trajectory, load, save
from scenes.edit import Edit
from scenes.harmonics import evaluate, sh_from_rgb
from scenes.poses import inverse, translation, yaw
from scenes.report import validate
from scenes.usd.edit import add_change

CAMERA = "front_camera"

SIZE = torch.tensor([4.2, 1.8, 1.5], dtype=torch.float64)


def body(count=1500, seed=0) -> Gaussians:
    """Splats on a box's skin, in its frame."""
    g = torch.Generator().manual_seed(seed)
    points = torch.rand(count, 3, generator=g) - 0.5
    points = points / (2 * points.abs().amax(1, keepdim=True)) * SIZE.float() + torch.tensor([0, 0, SIZE[2] / 2])
    sh = torch.randn(count, 4, 3, generator=g) * 0.2
    return Gaussians(points.float(), torch.randn(count, 4, generator=g), torch.full((count, 3), -2.5), torch.full((count,), 3.0), sh)


def test_harmonics_turn_with_the_splats():
    pose = yaw(0.7)[:3, :3]
    sh = torch.randn(5, 16, 3)
    direction = torch.nn.functional.normalize(torch.randn(5, 3), dim=1)
    there = evaluate(turned(sh, pose), direction @ pose.T.float())
    torch.testing.assert_close(there, evaluate(sh, direction), atol=1e-5, rtol=1e-4)


def test_splats_go_into_a_box_frame_and_back():
    pose = translation(30.0, -4.0, 0.5) @ yaw(2.1)
    local = body()
    world = moved(local, pose, torch.tensor([200.0, 200, 200]))
    back = moved(world, inverse(pose), SIZE)
    torch.testing.assert_close(back.means, local.means, atol=1e-4, rtol=0)
    torch.testing.assert_close(back.sh, local.sh, atol=1e-4, rtol=0)


def test_the_road_faint_and_wide_splats_stay_behind():
    g = body()
    g.means[0, 2], g.means[1, 0] = 0.0, 3.0
    g.logit_opacities[2], g.log_scales[3] = -6, 1.0
    kept = within_box(g, SIZE)
    assert not {(0, 1, 2, 3)[i] for i in range(4) if (kept.means == g.means[i]).all(1).any()}


def test_a_car_seen_from_one_side_is_completed_by_its_mirror_image():
    half = body()
    half = half.select(half.means[:, 1] > 0.1)
    whole, mirrored = completed(half, 1.0, 0.1)
    assert mirrored and len(whole) == 2 * len(half)
    flip = torch.tensor([1.0, -1, 1])
    there = evaluate(whole.sh[len(half) :], torch.nn.functional.normalize(torch.tensor([[1.0, -2, 0.5]]), dim=1).expand(len(half), 3))
    here = evaluate(half.sh, torch.nn.functional.normalize(torch.tensor([[1.0, 2, 0.5]]), dim=1).expand(len(half), 3))
    torch.testing.assert_close(there, here, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(whole.means[len(half) :], half.means * flip)
    same, untouched = completed(body(), 1.0, 0.34)
    assert not untouched and len(same) == len(body())


def test_a_mirrored_picture_is_the_picture_of_the_mirrored_car():
    from render import rasterize

    half = body()
    half = half.select(half.means[:, 1] > 0.1)
    mirror = completed(half, 1.0, 0.1)[0].select(torch.arange(len(half), 2 * len(half)))
    centre = torch.tensor([0.0, 0.0, 0.7], dtype=torch.float64)
    views = [looking_at(centre, torch.tensor([-5.0, side, 2.0], dtype=torch.float64), 96, 72) for side in (4.0, -4.0)]
    ours, theirs = rasterize(half, views[0]).rgb, rasterize(mirror, views[1]).rgb
    torch.testing.assert_close(ours, theirs.flip(1), atol=2e-3, rtol=0)


def test_a_tail_has_less_silhouette_than_a_car():
    g = body()
    assert silhouette(g, SIZE) > 0.95 > 0.5 > silhouette(g.select(g.means[:, 0] < -1.4), SIZE)


@pytest.mark.parametrize("seen", ["front left", "rear left", "rear right", "front right"])
def test_a_thumbnail_shows_the_corner_that_was_seen_most(seen):
    """Of a car whose nose is white, its tail black, its left red, its right green."""
    g = box(SIZE.tolist(), (0, 0, 0), step=0.1)
    sides = {"front": (1, 1, 1), "rear": (0, 0, 0), "left": (1, 0, 0), "right": (0, 1, 0)}
    way = g.means[:, :2] / SIZE[:2]
    side = torch.where(way[:, 0].abs() > way[:, 1].abs(), (way[:, 0] < 0).long(), 2 + (way[:, 1] < 0).long())
    painted = replace(g, sh=sh_from_rgb(torch.tensor(list(sides.values())).float()[side])[:, None])
    pixels = np.asarray(Image.open(io.BytesIO(thumbnail(Asset(painted, SIZE, "car", meta={"sectors": {seen: 5}})))))
    end, flank = (255 * np.array(sides[word]) for word in seen.split())
    assert [(np.abs(pixels.astype(int) - colour).max(-1) < 60).sum() > 5000 for colour in (end, flank)] == [True, True]


def test_a_parked_car_is_cut_out_in_whatever_frame_the_background_stands(parked_street):
    there = translation(3.0, -7.0, 1.0) @ yaw(0.5)
    background = Placed(moved(parked_street.background.gaussians, inverse(there), torch.tensor([1e3] * 3)), there)
    one, other = (
        next(c.asset for c in candidates(replace(s, actors=(), rig={})) if c.track == "veh_7")
        for s in (parked_street, replace(parked_street, background=background))
    )
    torch.testing.assert_close(other.gaussians.means, one.gaussians.means, atol=1e-3, rtol=0)


@pytest.mark.parametrize("size", [(4.2, 1.8, 1.5), (0.7, 0.7, 1.75), (12.0, 2.6, 3.3)], ids=["car", "pedestrian", "bus"])
def test_a_thumbnail_shows_all_of_its_asset(size):
    skin = box(size, (1.0, 0, 0), step=0.1)
    red = replace(skin, log_scales=skin.log_scales - 1)
    pixels = np.asarray(Image.open(io.BytesIO(thumbnail(Asset(red, size, "car"))))).astype(int)
    row, column = np.nonzero(pixels[..., 0] - pixels[..., 2] > 100)
    assert row.min() > 0 and row.max() < 239 and column.min() > 0 and column.max() < 319
    assert max(np.ptp(row) / 240, np.ptp(column) / 320) > 0.7


def test_a_thumbnail_shows_the_asset_on_grey():
    pixels = np.asarray(Image.open(io.BytesIO(thumbnail(Asset(body(), SIZE, "car")))))
    assert pixels.shape == (240, 320, 3) and tuple(pixels[0, 0]) == (184, 186, 191) and pixels.std() > 5


@pytest.fixture
def parked_street(street):
    """The street with a car standing in the background whose box the scene knows."""
    pose = translation(9.0, 3.5, 0.0) @ yaw(math.pi)
    car = moved(body(), pose, torch.tensor([200.0, 200, 200]))
    meta = {**street.meta, "parked": [
        {"track": "veh_7", "label": "car", "size": SIZE.tolist(), "world_from_box": pose.tolist()},
        {"track": "veh_8", "label": "pickup", "size": SIZE.tolist(), "world_from_box": translation(9.0, -90.0, 0.0).tolist()},
    ]}  # fmt: skip
    background = Placed(Gaussians.cat([street.background.gaussians, car]), street.background.world_from_local)
    return replace(street, background=background, meta=meta)


def test_parked_cars_and_movers_become_assets_and_the_rest_is_said(parked_street, tmp_path, capsys):
    ids = extract_assets(parked_street, tmp_path / "bank")
    assert ids and all(i.startswith("car/") for i in ids)
    bank = Databank(tmp_path / "bank")
    tracks = {bank.load(e.id).meta["track"]: e for e in bank.entries()}
    assert "veh_7" in tracks and tracks["veh_7"].views >= 10 and tracks["veh_7"].licence == "CC0-1.0" and tracks["veh_7"].thumb
    asset = bank.load(tracks["veh_7"].id)
    assert asset.gaussians.means[:, 2].min() > 0 and (asset.gaussians.means.abs() < torch.tensor([2.3, 1.1, 1.8])).all()
    assert "left out veh_8: no camera saw it from within 20 m" in capsys.readouterr().err


def test_what_was_extracted_before_is_kept_and_not_doubled(parked_street, tmp_path, capsys):
    ids = extract_assets(parked_street, tmp_path / "bank")
    capsys.readouterr()
    assert extract_assets(parked_street, tmp_path / "bank") == ids
    assert [e.id for e in Databank(tmp_path / "bank").entries()] == sorted(ids)
    assert f"kept {ids[0]} as it is" in capsys.readouterr().err
    other = replace(parked_street.background.gaussians, means=parked_street.background.gaussians.means + 1e-3)
    anew = extract_assets(replace(parked_street, background=replace(parked_street.background, gaussians=other)), tmp_path / "bank")
    assert set(anew) - set(ids), "a car of another fit is another one"


@pytest.fixture
def sharp_street(parked_street):
    """Fitted to pictures as large as its photos are."""
    return replace(parked_street, rig={name: camera.resized(384, 216) for name, camera in parked_street.rig.items()})


def _shots(scene):
    """What the scene's cameras see, twice as bright as it is: its photos, in other light."""

    def taken(camera, width, height):
        return to_bytes((2 * render_frame(scene, camera.resized(width, height)).rgb).clamp(0, 1))

    cameras = [scene.camera(name, int(t)).resized(384, 216) for name in scene.rig for t in scene.frame_times(name)]
    return [Shot(c, partial(taken, c)) for c in cameras]


def test_assets_keep_photos_of_themselves_alone(sharp_street):
    """Of the mover and of the parked car: each photo shows the asset where its own splats are, and nothing where they are not."""
    shots, found = _shots(sharp_street), {c.track: c for c in candidates(sharp_street)}
    for track in ("veh_1", "veh_7"):
        photos = found[track].photos(sharp_street, shots)
        assert photos, track
        asset = found[track].asset
        for photo in photos:
            pixels = torch.from_numpy(photo.read())
            assert pixels.shape == (photo.camera.height, photo.camera.width, 4)
            alone = rasterize(asset.gaussians, photo.camera, ("rgb", "alpha"))
            solid, shows = alone.alpha > 0.9, pixels[..., 3] == 255
            assert (shows & solid).sum() > 0.45 * solid.sum() and (shows & (alone.alpha < 0.01)).sum() < 0.15 * shows.sum()
            both = shows & solid
            lit = (2 * alone.rgb).clamp(0, 1)[both] - pixels[..., :3][both].float() / 255
            assert lit.abs().mean() < 0.06, track
            assert (pixels[..., :3][~shows] == 0).all()


def test_a_photo_that_is_shrunk_averages_its_pixels(sharp_street, monkeypatch):
    """A chessboard is grey from afar, not one of its fields or the other."""
    monkeypatch.setattr("recon.assets.photos.MOST_PIXELS", 24)

    def read(width, height):
        board = Image.fromarray((np.indices((216, 384)).sum(0) % 2 * 255).astype(np.uint8)).convert("RGB")
        return np.asarray(board.resize((width, height), Image.Resampling.BOX))

    (mover,) = [c for c in candidates(sharp_street) if c.track == "veh_1"]
    photos = mover.photos(sharp_street, [replace(s, read=read) for s in _shots(sharp_street)])
    shown = np.concatenate([pixels[..., :3][pixels[..., 3] == 255] for pixels in (photo.read() for photo in photos)])
    assert len(shown) > 50 and abs(shown.mean() - 127) < 15 and shown.std() < 30


def _of_mover(street, times, **shot):
    """Photos of the street's mover at some of the front camera's frames, in which red says the column and green the row."""
    places = np.stack([*np.meshgrid(np.arange(256), np.arange(144)), np.zeros((144, 256))], -1).astype(np.uint8)
    cameras = [street.camera(CAMERA, int(t)).resized(256, 144) for t in street.frame_times(CAMERA)[times]]
    shots = [Shot(camera, lambda width, height: np.asarray(Image.fromarray(places).resize((width, height))), **shot) for camera in cameras]
    (mover,) = street.actors
    return cameras, photos_of(mover.asset, street, shots, mover.trajectory, 1)


def test_a_photo_shows_in_each_direction_what_was_there(street):
    (camera,), (photo,) = _of_mover(street, [7])
    pose = street.actors[0].trajectory.at(camera.time_us)
    torch.testing.assert_close((pose @ photo.camera.world_from_cam)[:3, 3], camera.world_from_cam[:3, 3])
    pixels = torch.from_numpy(photo.read())
    shown = pixels[..., 3] == 255
    ways = camera_rays(photo.camera)[shown].double() @ (pose @ photo.camera.world_from_cam)[:3, :3].T
    there = camera.lens.project(ways @ camera.world_from_cam[:3, :3]) - 0.5
    assert shown.sum() > 300 and (pixels[shown][:, :2] - there).abs().max() < 0.55


def test_of_two_photos_of_one_moment_the_nearer_one_is_kept(street):
    cameras, (photo,) = _of_mover(street, [6, 7])
    assert photo.camera.time_us == cameras[1].time_us


@pytest.mark.parametrize(("metres", "kept"), [(0.9, 0), (1.1, 1)])
def test_from_right_before_an_object_nothing_is_pictured(street, metres, kept):
    """Nearness is to its box, not to its middle."""
    mount = looking_at(torch.zeros(3, dtype=torch.float64), torch.tensor([2.1 + metres, 0, 0.75], dtype=torch.float64), 200, 200)
    camera = replace(mount, lens=Pinhole(40, 40, 100, 100), world_from_cam=street.actors[0].trajectory.at(START_US) @ mount.world_from_cam)
    shot = Shot(replace(camera, time_us=START_US), lambda width, height: np.zeros((height, width, 3), np.uint8))
    assert len(list(_views([shot], street.actors[0].trajectory, SIZE))) == kept


def test_what_the_recording_car_hides_is_no_photo(street):
    below = np.arange(144)[:, None] >= np.full((1, 256), 60)
    assert _of_mover(street, [7], ego=below)[1] == ()


def test_photos_of_one_direction_are_few_and_apart(parked_street):
    (mover,) = [c for c in candidates(parked_street) if c.track == "veh_1"]
    photos = mover.photos(parked_street, _shots(parked_street))
    sectors = Counter(round(math.degrees(math.atan2(*p.camera.world_from_cam[:2, 3].flip(0).tolist())) / 12) for p in photos)
    assert max(sectors.values()) == 1  # all were taken within a second


def test_what_hides_an_object_is_no_photo_of_it(sharp_street):
    (parked,) = [c for c in candidates(sharp_street) if c.track == "veh_7"]
    wall = box((0.3, 6.0, 4.0), (0.9, 0.9, 0.2))
    wall = replace(wall, means=wall.means + torch.tensor([5.5, 3.5, 0.0]))
    background = replace(sharp_street.background, gaussians=Gaussians.cat([sharp_street.background.gaussians, wall]))
    hidden = replace(sharp_street, background=background)
    front = [s for s in _shots(hidden) if s.camera.world_from_cam[0, 3] < 5]
    photos = parked.photos(hidden, front)
    for photo in photos:  # from beside the wall some of it may be seen, but never the wall
        pixels = torch.from_numpy(photo.read())
        yellow = (pixels[..., 0] > 200) & (pixels[..., 1] > 200) & (pixels[..., 2] < 150)
        assert yellow.sum() < 0.02 * (pixels[..., 3] == 255).sum()
    assert len(photos) < len(parked.photos(sharp_street, front))


def test_what_bends_on_its_way_has_no_photos(parked_street):
    (mover,) = [c for c in candidates(parked_street) if c.track == "veh_1"]
    assert replace(mover, instance=None).photos(parked_street, _shots(parked_street)) == ()


def test_a_scene_folder_with_photos_gives_its_assets_theirs(parked_street, tmp_path):
    scene, bank = replace(parked_street, rig=rig(384, 216)), Databank(tmp_path / "bank")
    save(scene, tmp_path / "s1")
    keep_photos(tmp_path / "s1", [(CAMERA, s.camera.time_us, from_bytes(s.read(384, 216))) for s in _shots(scene)[:8]])
    loaded = [bank.load(id) for id in extract_assets(tmp_path / "s1", tmp_path / "bank")]
    assert all(asset.photos for asset in loaded) and not validate(tmp_path / "bank")


def test_assets_are_cut_from_what_was_recorded_whatever_was_edited_since(parked_street, tmp_path):
    save(parked_street, tmp_path / "as_it_was")
    save(parked_street, tmp_path / "edited")
    extract_assets(tmp_path / "as_it_was", tmp_path / "wanted")
    bank = Databank(tmp_path / "other")
    van = bank.load(bank.add(car("van", (0.9, 0.9, 0.1))))
    track = parked_street.actors[0].track
    add_change(tmp_path / "edited", "edit", load(tmp_path / "edited"), Edit(replace={track: van}), {"kind": "edit"})
    assert load(tmp_path / "edited").actors[0].asset.label == "van"
    extract_assets(tmp_path / "edited", tmp_path / "got")
    wanted, got = (Databank(tmp_path / name) for name in ("wanted", "got"))
    assert [e.id for e in got.entries()] == [e.id for e in wanted.entries()]
    assert all(torch.equal(got.load(e.id).gaussians.sh, wanted.load(e.id).gaussians.sh) for e in got.entries())
    assert track not in [c.track for c in candidates(load(tmp_path / "edited"))], "nor is the van an asset of this drive in memory"


def test_what_no_photo_shows_is_no_asset(parked_street, tmp_path, capsys):
    """Of the drive's photos one is left, of the camera that has passed it by then."""
    scene = replace(parked_street, rig=rig(384, 216))
    save(scene, tmp_path / "s1")
    shot = _shots(scene)[len(scene.frame_times("front_camera")) - 1]
    keep_photos(tmp_path / "s1", [("front_camera", shot.camera.time_us, from_bytes(shot.read(384, 216)))])
    with pytest.raises(ValueError, match="good enough"):
        extract_assets(tmp_path / "s1", tmp_path / "bank")
    assert "left out veh_7 (car): no photo shows most of it" in capsys.readouterr().err


def beside(scene, splats: Gaussians, at: tuple[float, float, float]):
    """The scene with more splats in its background."""
    more = replace(splats, means=splats.means + torch.tensor(at))
    return replace(scene, background=replace(scene.background, gaussians=Gaussians.cat([scene.background.gaussians, more])))


def test_what_stands_behind_a_wall_was_not_seen(parked_street):
    """Nor do its sides and directions count in which it would have been, but for the wall."""

    def sight(scene):
        box = Trajectory(torch.zeros(1, dtype=torch.int64), translation(9.0, 3.5, 0.0)[None] @ yaw(math.pi))
        return sight_of(Views(scene), box, SIZE)

    free = sight(parked_street)
    hidden = sight(beside(parked_street, box((9.0, 0.3, 3.0), (0.6, 0.6, 0.6)), (8.0, 2.3, 0.0)))
    assert free.views >= 10 and free.left > 0 and hidden.views == 0 and hidden.left < 0.05 * free.left
    assert free.nearest == hidden.nearest and not any(hidden.sectors.values())
    assert free.views == sum(free.sectors.values()) and free.sectors["front left"] >= 8
    # a car parked before its nose hides that, and not its flank: from the corner only the flank is seen, and the nose from nowhere
    parked = sight(beside(parked_street, box((4.2, 1.8, 1.5), (0.2, 0.2, 0.8)), (4.4, 3.5, 0.0)))
    assert 0 < parked.views <= free.views and parked.left > 0.95 * free.left and parked.nearest == free.nearest
    assert parked.sectors["left"] == parked.views > free.sectors["left"]


@pytest.mark.parametrize(("beside", "left", "right"), [(3.0, 0, 1), (-3.0, 1, 0), (-0.5, 0, 0)])
def test_a_side_appears_as_large_as_its_solid_angle_is(street, beside, left, right):
    """From 8 m behind, and from over there; all of the side is in the picture. From right behind none is."""
    front = replace(street.rig[CAMERA], times_us=street.rig[CAMERA].times_us[:1])
    scene = replace(street, rig={CAMERA: front})
    views = SimpleNamespace(scene=scene, at=lambda *at: (scene.camera(*at), torch.full((54, 96), torch.inf)))
    sight = sight_of(views, Trajectory(torch.zeros(1, dtype=torch.int64), translation(9.0, beside, 0.0)[None]), SIZE)
    part = (abs(beside) - 0.9) / (8**2 + beside**2 + (1.5 - 0.75) ** 2) ** 1.5
    assert (sight.left, sight.right) == pytest.approx((left * part, right * part))


def test_a_scene_without_objects_says_so(street, tmp_path):
    with pytest.raises(ValueError, match="good enough"):
        extract_assets(replace(street, actors=()), tmp_path / "bank")
    assert not (tmp_path / "bank").exists()


def test_a_movers_light_is_that_of_where_it_was_nearest(street):
    """The one that comes along is lit as the road at its path's end, though that is dark where half of its path is done."""
    g = street.background.gaussians
    dark = replace(g, sh=torch.where((g.means[:, 0] > 17.5)[:, None, None], g.sh - 0.8, g.sh))
    found = {
        c.track: c.asset.meta["ground_linear"] for c in candidates(replace(street, background=replace(street.background, gaussians=dark)))
    }
    bright = {c.track: c.asset.meta["ground_linear"] for c in candidates(street)}
    assert found["veh_1"] == pytest.approx(bright["veh_1"], rel=0.1)
