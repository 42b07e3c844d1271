"""What photos add to rendered views."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from PIL import Image

from render import render_frame
from render.album import keep_photos, references_of, shots_in
from render.compare import psnr
from render.frame_types import Frame
from render.rays import camera_rays
from render.references import COVERED, GONE, READS, RIM, References, Shot
from render.video import to_bytes
from scenes.camera import Camera
from scenes.edit import Edit
from scenes.files import load, save
from scenes.lenses import Fisheye
from scenes.poses import CAM_FROM_FLU, translation, yaw
from scenes.scene import Scene
from scenes.usd.edit import add_change

CAMERA = "front_camera"


def blurred(scene: Scene) -> Scene:
    """The scene with every splat half as large again: what the photos show, it does not."""

    def swollen(g):
        return replace(g, log_scales=g.log_scales + 0.4)

    actors = tuple(replace(a, asset=replace(a.asset, gaussians=swollen(a.asset.gaussians))) for a in scene.actors)
    return replace(scene, background=replace(scene.background, gaussians=swollen(scene.background.gaussians)), actors=actors)


def shots(scene: Scene, which=range(8)) -> list[Shot]:
    made = []
    for i in which:
        camera = scene.camera(CAMERA, int(scene.frame_times(CAMERA)[i]))
        made.append(Shot(camera, lambda w, h, c=camera: to_bytes(render_frame(scene, c.resized(w, h)).rgb)))
    return made


def better(frame) -> torch.Tensor:
    return torch.lerp(frame.rgb.clamp(0, 1), frame.reference, frame.trust[..., None])


def views(scene, times, shift=0.0):
    ego = scene.ego.shifted(lateral=shift)
    return [render_frame(scene, scene.camera(CAMERA, int(t), ego), READS) for t in times]


@pytest.fixture(scope="module")
def unclear(street):
    return blurred(street)


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_photos_bring_views_nearer_to_the_truth(street, unclear, shift):
    times = street.frame_times(CAMERA)[2:5]
    found = list(References(shots(street), unclear).along(views(unclear, times, shift)))
    truth = [f.rgb for f in views(street, times, shift)]
    assert all(psnr(better(f), t) > psnr(f.rgb, t) + 1 for f, t in zip(found, truth, strict=True))


def snow(width: int, height: int) -> np.ndarray:
    """A photo that has a colour of its own in every pixel, and shrunk the means of these; with white everywhere, so that it is no noise."""
    pixels = np.random.default_rng(5).integers(60, 180, (54, 96, 3)).astype(np.uint8)
    pixels[::4, ::4] = 255
    return np.array(Image.fromarray(pixels).resize((width, height), Image.Resampling.BOX))


@pytest.mark.parametrize("shrink", [1, 2])
def test_from_where_a_photo_was_taken_it_is_seen_pixel_by_pixel(street, shrink):
    camera = at_hand(street)
    frame = render_frame(street, camera.resized(96 // shrink, 54 // shrink), READS)
    (found,) = References([Shot(camera, snow)], street).along([frame])
    told, photo = found.trust > 0, torch.from_numpy(snow(96 // shrink, 54 // shrink)) / 255
    assert told[frame.instance == -1].any() and told[frame.instance == 1].any() and told.float().mean() > 0.5
    assert (found.reference - photo)[told].abs().max() < 1e-3


def test_what_a_photo_adds_in_its_dark_corner_is_as_much_where_the_frame_is_light(street):
    """The detail of a photo whose lens halves all light, in a frame of one that does not."""
    camera, base = at_hand(street), render_frame(street, at_hand(street), READS)
    dim = replace(camera, flat_field=torch.full((2, 2, 3), 0.5))
    half = to_bytes(render_frame(street, dim).rgb + 0.05)
    (found,) = References([Shot(dim, lambda w, h: half)], street).along([base])
    told = (found.trust > 0) & (base.rgb < 0.85).all(-1) & (base.rgb > 0).all(-1)
    added = (found.reference - base.rgb)[told]
    assert told.float().mean() > 0.3 and abs(float(added.median()) - 0.1) < 0.01


def test_a_wider_view_gets_of_a_photo_what_its_own_pixels_average(street):
    """As wide in pixels as the photo, it has half as many a radian: in its middle it shows the photo at half the size."""
    camera = at_hand(street)
    wide = replace(camera, lens=replace(camera.lens, cy=26.5))
    tele = replace(camera, lens=replace(camera.lens.scaled(2, 2), cx=48.0, cy=27.0))
    (found,) = References([Shot(tele, snow)], street).along([render_frame(street, wide, READS)])
    middle = slice(13, 40), slice(24, 72)
    told, photo = found.trust[middle] > 0, torch.from_numpy(snow(48, 27)) / 255
    assert told.float().mean() > 0.4 and (found.reference[middle] - photo)[told].abs().quantile(0.9) < 0.01


def test_the_sky_of_a_photo_is_that_behind_a_haze(street):
    """Splats too faint to be what stands there do not bring the sky near."""
    g = street.background.gaussians
    haze = g.select(torch.zeros(1, dtype=torch.int64))
    scale = torch.full((1, 3), 3.0)
    haze = replace(haze, means=torch.tensor([[60.0, 0.0, 25.0]]), log_scales=scale, logit_opacities=torch.tensor([-1.7]))
    hazy = replace(street, background=replace(street.background, gaussians=type(g).cat([g, haze])))
    camera = at_hand(hazy)
    frame = render_frame(hazy, camera, READS)
    faint = (frame.instance == -1) & (frame.alpha > 0.05) & (frame.alpha < 0.25) & frame.depth.isfinite()
    (found,) = References([Shot(camera, snow)], hazy).along([frame])
    assert faint.sum() > 100 and found.trust[faint].float().mean() > 0.5


def stands_near(frame: Frame) -> torch.Tensor:
    """bool `[H, W]`: where something stands, or so near to it that the sky there is not told."""
    return torch.nn.functional.max_pool2d((frame.alpha > COVERED).float()[None], 2 * RIM + 1, 1, RIM)[0] > 0


def at_hand(street) -> Camera:
    return street.camera(CAMERA, int(street.frame_times(CAMERA)[3]))


def aside(camera: Camera, metres: float, later_us: int = 0) -> Camera:
    return replace(camera, world_from_cam=translation(0.0, metres, 0.0) @ camera.world_from_cam, time_us=camera.time_us + later_us)


def test_photos_count_by_how_far_off_and_how_long_ago_they_were_taken(street):
    camera = at_hand(street)
    frame = render_frame(street, camera, READS)
    shots = [Shot(aside(camera, *off), snow) for off in ((0.0, 1_000_000), (0.0, -300_000), (3.0, 0))]
    best = References(shots, street).chosen(frame)
    assert [index for index, _ in best] == [1, 0]
    trusts = []
    for metres in (0.0, 2.0):
        (found,) = References([Shot(aside(camera, metres), snow)], street).along([frame])
        near = (found.trust > 0) & (frame.instance == 0) & (frame.depth < 15)
        trusts.append(float(found.trust[near].median()))
    assert trusts[1] < 0.7 * trusts[0]


def test_another_cameras_photo_of_a_predicted_moment_is_looked_at(street):
    camera = at_hand(street)
    frame = render_frame(street, camera, READS)
    shots = [Shot(camera, snow), Shot(aside(camera, 1.0), snow), Shot(aside(camera, 0.0, 100_000), snow)]
    assert sorted(index for index, _ in References(shots, street).chosen(frame, [camera])) == [1, 2]


def test_sky_is_believed_where_photos_agree_and_nothing_stands_near(street):
    camera = at_hand(street)
    frame = render_frame(street, camera, READS)
    later = aside(camera, 0.0, 1)
    (alike,) = References([Shot(camera, snow), Shot(later, snow)], street).along([frame])
    (apart,) = References([Shot(camera, snow), Shot(later, lambda w, h: snow(w, h)[::-1].copy())], street).along([frame])
    stands = stands_near(frame)
    sky, inside = frame.instance < 0, torch.zeros_like(stands)
    rim = camera.width // 16
    inside[rim:-rim, rim:-rim] = True  # towards its border a photo's sky fades
    assert (sky & stands).any() and not alike.trust[sky & stands].any() and alike.trust[sky & ~stands & inside].min() > 0.5
    assert apart.trust[sky].mean() < 0.5 * alike.trust[sky].mean()


def test_a_predicted_frames_photo_and_those_to_come_are_not_looked_at(street, unclear):
    frames = views(unclear, street.frame_times(CAMERA)[3:6])
    cameras = [f.camera for f in frames]
    alone = References(shots(street, (0, 1, 2, 6, 7)), unclear)
    (first,) = References(shots(street), unclear).along(frames[:1], cameras)
    (wanted,) = alone.along(frames[:1])
    assert torch.equal(first.reference, wanted.reference) and torch.equal(first.trust, wanted.trust)


def test_of_the_recording_car_in_a_photo_nothing_is_carried_over(street, unclear):
    ego = np.zeros((9, 16), bool)
    ego[6:] = True

    def painted(read, width, height):
        photo = read(width, height).copy()
        photo[2 * height // 3 :] = 255
        return photo

    frames = views(unclear, street.frame_times(CAMERA)[3:4])
    told = [replace(s, read=partial(painted, s.read), ego=ego) for s in shots(street)]
    (found,) = References(told, unclear).along(frames)
    (untold,) = References([replace(s, ego=None) for s in told], unclear).along(frames)
    low = slice(2 * found.rgb.shape[0] // 3 + 2, None)
    assert not found.trust[low].any() and found.trust[: low.start - 8].any()
    assert (untold.reference[low] - found.rgb[low]).max() > 0.3


def test_what_a_photo_adds_is_exposed_as_the_frame_is(street, unclear):
    """A camera that follows the light: photos exposed by a half less add as much to a frame as if all had been taken alike."""
    rig, times = unclear.rig_camera(CAMERA), unclear.frame_times(CAMERA)
    gains = torch.ones(len(rig.times_us), 3)
    gains[:3] = 0.5
    following = [replace(s, rig={**s.rig, CAMERA: replace(rig, gains=gains)}) for s in (street, unclear)]
    (alike,) = References(shots(street, (0, 1, 2)), unclear).along(views(unclear, times[3:4]))
    (found,) = References(shots(following[0], (0, 1, 2)), following[1]).along(views(following[1], times[3:4]))
    assert torch.equal(found.rgb, alike.rgb) and (found.trust - alike.trust).abs().max() < 0.05
    added, wanted = ((f.reference - f.rgb) * f.trust[..., None] for f in (found, alike))
    for shown in (found.instance == 0, found.instance == 1):  # the street, and who drives along, who is lit as the exposure follows
        assert wanted[shown].square().sum() > 1e-3
        assert float((added * wanted)[shown].sum() / wanted[shown].square().sum()) == pytest.approx(1, abs=0.1)


def test_without_photos_nothing_is_trusted(street):
    (frame,) = References([], street).along(views(street, street.frame_times(CAMERA)[:1]))
    assert not frame.trust.any() and torch.equal(frame.reference, frame.rgb.clamp(0, 1))


def test_a_splat_scene_that_explains_its_photos_is_left_nearly_as_it_is(street):
    (frame,) = References(shots(street), street).along(views(street, street.frame_times(CAMERA)[3:4], 0.5))
    assert (better(frame) - frame.rgb.clamp(0, 1)).abs().max() < 2 / 255


def test_a_fisheyes_photos_are_found_though_its_image_ends_within_the_picture(street):
    camera = street.camera(CAMERA, int(street.frame_times(CAMERA)[3]))
    lens = Fisheye(camera.width / 6, camera.width / 6, camera.width / 2, camera.height / 2, -0.05)
    round_ = replace(camera, lens=lens)
    assert not camera_rays(round_)[0, 0].any() and camera_rays(round_)[camera.height // 2, camera.width // 2].any()
    frame = render_frame(street, round_, READS)
    assert References([Shot(round_, lambda w, h: np.zeros((h, w, 3), np.uint8))], street).chosen(frame) == [(0, pytest.approx(1.0))]


def test_shares_of_photos_change_little_along_a_path(street, unclear):
    references = References(shots(street), unclear)
    start, end = (int(street.frame_times(CAMERA)[i]) for i in (2, 3))
    shares = []
    for t in range(start, end, 1000):
        depth = torch.full((54, 96), 12.0)
        frame = replace(render_frame(unclear, street.camera(CAMERA, t)), depth=depth)
        share = torch.zeros(8)
        for index, value in references.chosen(frame):
            share[index] = value
        shares.append(share)
    assert torch.stack(shares).diff(dim=0).abs().max() < 0.06


@pytest.mark.parametrize("shift", [0.0, 0.8])
def test_photos_too_far_off_to_be_chosen_are_not_asked(street, monkeypatch, shift):
    times = street.frame_times(CAMERA)
    of_all = [Shot(street.camera(name, int(t)), lambda w, h: np.zeros((h, w, 3), np.uint8)) for name in street.rig for t in times]
    references, asked = References(of_all, street), []
    shows = References._shows
    monkeypatch.setattr(References, "_shows", lambda self, some, *told: asked.extend(some.tolist()) or shows(self, some, *told))
    for view in views(street, times[::3], shift):
        for predicted in ([], [view.camera]):
            monkeypatch.setattr("render.references.AT_ONCE", len(of_all))
            best = references.chosen(view, predicted)
            monkeypatch.setattr("render.references.AT_ONCE", 2)
            asked.clear()
            assert references.chosen(view, predicted) == best
            assert 2 < len(asked) < len(of_all)


def test_an_actor_that_was_removed_leaves_no_ghost(street, unclear):
    empty = replace(unclear, actors=())
    references = References(shots(street), unclear, empty)
    assert references.ids.tolist() == [0, GONE, -1]
    times = street.frame_times(CAMERA)[6:8]
    found = list(references.along(views(empty, times)))
    there = [f.instance == 1 for f in views(unclear, times)]
    truth = [f.rgb for f in views(replace(street, actors=()), times)]
    for f, car, t in zip(found, there, truth, strict=True):
        assert car.sum() > 20 and psnr(better(f), t, car) > psnr(f.rgb, t, car) - 0.5


def before_the_sky(street: Scene) -> Scene:
    """The street without houses: its car, 5 m tall then, stands before the sky."""
    g = street.background.gaussians
    (actor,) = street.actors
    tall = replace(actor.asset.gaussians, means=actor.asset.gaussians.means * torch.tensor([1.0, 1.0, 3.3]))
    actor = replace(actor, asset=replace(actor.asset, gaussians=tall))
    return replace(street, background=replace(street.background, gaussians=g.select(g.means[:, 2] < 0.1)), actors=(actor,))


def test_an_actor_that_was_removed_leaves_no_rim_in_the_sky(street):
    """Where a photo shows it, and beside it, nothing is known of the sky behind."""
    recorded = before_the_sky(street)
    camera = recorded.camera(CAMERA, int(street.frame_times(CAMERA)[6]))
    stands = render_frame(recorded, camera, ("alpha", "instance"))
    empty = replace(recorded, actors=())
    frame = render_frame(empty, camera, READS)
    (found,) = References([Shot(camera, snow)], recorded, empty).along([frame])
    near = stands_near(stands)
    behind = near & (frame.instance == -1) & (render_frame(empty, camera, ("alpha",)).alpha == 0)
    rim = behind & (stands.instance == -1)
    assert behind.sum() > 100 and rim.sum() > 20 and not found.trust[behind].any()
    assert found.trust[(frame.instance == -1) & ~near].max() > 0.5


def test_what_nobody_knew_in_the_frame_before_is_not_carried_over(street):
    """Sky that a car stood before then is told now as if there had been no frame before."""
    scene = before_the_sky(street)
    times = [int(street.frame_times(CAMERA)[i]) for i in (5, 7)]
    first, second = (render_frame(scene, replace(scene.camera(CAMERA, times[1]), time_us=t), READS) for t in times)
    references = References([Shot(second.camera, snow)], scene)
    (alone,) = references.along([second])
    _, carried = references.along([first, second])
    freed = stands_near(first) & (first.instance == -1) & ~stands_near(second)
    assert freed.sum() > 10 and alone.trust[freed].max() > 0.5
    assert torch.equal(carried.trust[freed], alone.trust[freed])


def test_an_actor_keeps_its_detail_when_one_before_it_is_removed(street, unclear):
    """Though its number changes."""
    first = replace(unclear.actors[0], track="first", trajectory=unclear.actors[0].trajectory.shifted(forward=-12.0))
    both = replace(unclear, actors=(first, *unclear.actors))
    frames = views(unclear, street.frame_times(CAMERA)[7:8])
    (found,), (wanted,) = (References(shots(street), s, unclear).along(frames) for s in (both, unclear))
    mine = frames[0].instance == 1
    assert wanted.trust[mine].mean() > 0.3 and (found.trust - wanted.trust)[mine].abs().mean() < 0.02


def test_a_reference_is_a_picture_and_trust_a_share(street):
    """Though a cubic overshoots where it carries what is known beside what is not, and a frame is brighter than the photo was."""
    ego = np.random.default_rng(2).random((9, 16)) > 0.5
    camera = at_hand(street)
    black_and_white = Shot(camera, lambda w, h: np.where(snow(w, h) > 120, 255, 0).astype(np.uint8), ego)
    brighter = torch.cat([torch.eye(3) * 1.5, torch.zeros(3, 1)], 1)
    frames = [render_frame(street, replace(aside(camera, 0.05 * i), exposure=brighter), READS) for i in range(3)]
    for found in References([black_and_white], street).along(frames):
        for told in (found.trust, found.reference):
            assert told.min() >= 0 and 0.5 < told.max() <= 1


def test_what_stands_in_an_actors_place_is_not_given_its_detail(street):
    (actor,) = street.actors
    other = replace(actor.asset, gaussians=actor.asset.gaussians.select(torch.arange(50)))
    assert References([], street, replace(street, actors=(replace(actor, asset=other),))).ids.tolist() == [0, GONE, -1]


def test_an_actors_detail_moves_with_it(street, unclear):
    def aside(scene):
        (actor,) = scene.actors
        path = replace(actor.trajectory, world_from_body=translation(0.0, 1.0, 0.0) @ actor.trajectory.world_from_body)
        return replace(scene, actors=(replace(actor, trajectory=path),))

    (frame,) = References(shots(street), unclear, aside(unclear)).along(views(aside(unclear), street.frame_times(CAMERA)[7:8]))
    (truth,) = views(aside(street), street.frame_times(CAMERA)[7:8])
    car = frame.instance == 1
    assert psnr(better(frame), truth.rgb, car) > psnr(frame.rgb, truth.rgb, car) + 0.5


def test_a_photo_from_before_the_drives_first_moment_is_kept(street, tmp_path):
    """Of a clock that begins at 0, by which one camera turned out to be early."""
    path = replace(street.ego, times_us=street.ego.times_us - street.ego.times_us[0])
    times = [-3000, 97_000, 197_000, 500_000]
    keep_photos(tmp_path, [(CAMERA, time_us, torch.rand(54, 96, 3)) for time_us in times])
    assert [shot.camera.time_us for shot in shots_in(tmp_path, replace(street, ego=path))] == times


def test_a_scene_folder_keeps_its_photos_and_knows_what_was_edited(street, tmp_path):
    folder = tmp_path / "s1"
    save(street, folder)
    assert references_of(folder, street) is None
    pictures = [(CAMERA, s.camera.time_us, torch.rand(54, 96, 3)) for s in shots(street)]
    keep_photos(folder, pictures)
    add_change(folder, "gone", load(folder), Edit(remove=("veh_1",)), {})
    edited = load(folder)
    references = references_of(folder, edited)
    assert not edited.actors and len(references.shots) == 8 and [a.track for a in references.recorded.actors] == ["veh_1"]
    assert references.shots[0].read(48, 27).shape == (27, 48, 3)
    next((folder / "photos" / CAMERA).iterdir()).write_bytes(b"no picture")
    with pytest.raises(ValueError, match="photo is done without"):
        for shot in references.shots:
            shot.read(96, 54)


def test_a_photos_sky_fades_towards_its_border(street):
    """A photo that is brighter than the sky that a scene shows, seen by a camera turned away by half of its view: no edge stands there."""
    nothing = replace(street.background, gaussians=street.background.gaussians.select(torch.zeros(0, dtype=torch.int64)))
    open_ = replace(street, background=nothing, actors=())
    camera = street.camera(CAMERA, int(street.frame_times(CAMERA)[3])).resized(320, 180)
    brighter = Shot(camera, lambda w, h: to_bytes((render_frame(open_, camera.resized(w, h)).rgb + 0.1).clamp(0, 1)))
    turned = replace(camera, world_from_cam=camera.world_from_cam @ CAM_FROM_FLU @ yaw(0.4) @ CAM_FROM_FLU.mT)
    (found,) = References([brighter], open_).along([render_frame(open_, turned, READS)])
    added = (better(found) - found.rgb.clamp(0, 1)).amax(-1)[80]
    assert added.max() > 0.07 and added.min() == 0, "the photo shows a part of it"
    assert added.diff().abs().max() < 0.02
