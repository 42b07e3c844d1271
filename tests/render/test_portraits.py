"""What the photos of an asset add to views of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from street import car

from recon.assets.looking import looking_at
from render import rasterize, render_frame
from render.compare import psnr
from render.portraits import Portraits, _detail
from render.references import READS, References
from scenes import Actor, Camera, Trajectory
from scenes.asset import AssetPhoto
from scenes.standing import standing_pose

CAMERA = "front_camera"


def painted():
    """A car with a pattern of a car's detail; without it, it is `car()`."""
    asset = car()
    g = asset.gaussians
    pattern = torch.sin((g.means[:, :1] + g.means[:, 1:2]) * 7) * torch.cos(g.means[:, 2:] * 7)
    return replace(asset, gaussians=replace(g, sh=g.sh + 0.8 * pattern[:, None]))


def photographed(asset, degrees, gain=1.0, time_us=7) -> AssetPhoto:
    """Taken from so many degrees to the left of its nose, 7 m away."""
    middle = torch.tensor([0.0, 0.0, 0.75], dtype=torch.float64)
    turn = np.radians(degrees)
    eye = torch.tensor([7 * np.cos(turn), 7 * np.sin(turn), 1.5], dtype=torch.float64)
    camera = replace(looking_at(middle, eye, 160, 120), time_us=time_us)
    frame = rasterize(asset.gaussians, camera, ("rgb", "alpha"))
    solid = frame.alpha > 0.5
    rgb = (frame.rgb / frame.alpha.clamp_min(1e-6)[..., None] * gain).clamp(0, 1) * solid[..., None]
    pixels = (torch.cat([rgb, solid[..., None].float()], -1) * 255).round().to(torch.uint8).numpy()
    return AssetPhoto(camera, lambda: pixels)


def standing(street, asset, yaw=0.3):
    """The street with the asset on it, 7 m ahead of the car."""
    pose = standing_pose(street, torch.tensor([9.0, 1.0], dtype=torch.float64), yaw, asset.size)
    there = replace(asset, meta={**asset.meta, "inserted": True})
    return replace(street, actors=(*street.actors, Actor(there, Trajectory(torch.tensor([0]), pose[None]), "put_in")))


def view(scene, index=2) -> Camera:
    return scene.camera(CAMERA, int(scene.frame_times(CAMERA)[index])).resized(192, 108)


def better(frame):
    return torch.lerp(frame.rgb.clamp(0, 1), frame.reference, frame.trust[..., None])


REAR = (150, 165, 180, 195)


def seen(street, photos, **how):
    """A frame of the plain car with what its photos say, and what the painted one looks like there."""
    scene = standing(street, replace(car(), photos=tuple(photos)))
    frame = render_frame(scene, view(scene), READS)
    (found,) = References([], scene).along([frame], **how)
    truth = render_frame(standing(street, painted()), view(scene), ("rgb",)).rgb
    return found, truth, frame.instance == 2


def test_photos_of_an_asset_bring_it_nearer_to_the_truth_wherever_it_is_put(street):
    found, truth, mine = seen(street, [photographed(painted(), d) for d in REAR])
    assert int(mine.sum()) > 300
    assert psnr(better(found), truth, mine) > psnr(found.rgb, truth, mine) + 2
    assert not found.trust[~mine].any() and torch.equal(better(found)[~mine], found.rgb.clamp(0, 1)[~mine])


@pytest.mark.parametrize("shrink", [1, 2])
def test_from_where_a_photo_was_taken_its_detail_is_seen_pixel_by_pixel(street, shrink):
    taken = photographed(car(), 160)
    camera, pixels = taken.camera, taken.read().astype(np.int64)
    height, width = camera.height // shrink, camera.width // shrink
    snow = np.random.default_rng(3).integers(-40, 40, (camera.height, camera.width, 1))
    pixels[..., :3] = (pixels[..., :3] + snow).clip(0, 255) * (pixels[..., 3:] > 0)
    scene = standing(street, replace(car(), photos=(AssetPhoto(camera, lambda: pixels.astype(np.uint8)),)))
    there = replace(camera, world_from_cam=scene.actors[1].trajectory.world_from_body[0] @ camera.world_from_cam)
    frame = render_frame(scene, there.resized(width, height), READS)
    (found,) = References([], scene).along([frame])
    told = found.trust > 0.5
    added = (found.reference - frame.rgb)[told].mean(-1)
    wanted = torch.from_numpy(snow.reshape(height, shrink, width, shrink).mean((1, 3))).float()[told]
    assert told.sum() > 300 and torch.corrcoef(torch.stack([added, wanted]))[0, 1] > 0.9


def test_a_photo_that_splats_explain_adds_nothing_whatever_its_size(street):
    """Half as large as the pictures that they were fitted to, in which their pixels hide half as much."""
    large = replace(street, rig={CAMERA: street.rig[CAMERA].resized(384, 216)})
    taken = photographed(car(), 160).camera.resized(48, 36)
    frame = rasterize(car().gaussians, taken, ("rgb", "alpha"), model=large.model_for(taken))
    rgba = torch.cat([frame.rgb / frame.alpha.clamp_min(1e-6)[..., None], (frame.alpha > 0.5).float()[..., None]], -1)
    pixels = (rgba.clamp(0, 1) * rgba[..., 3:] * 255).round().to(torch.uint8).numpy()
    scene = standing(large, replace(car(), photos=(AssetPhoto(taken, lambda: pixels),)))
    there = replace(taken, world_from_cam=scene.actors[1].trajectory.world_from_body[0] @ taken.world_from_cam)
    frame = render_frame(scene, there, READS)
    (found,) = References([], scene).along([frame])
    assert (found.trust > 0.5).sum() > 100
    assert (better(found) - frame.rgb.clamp(0, 1)).abs().max() < 2 / 255


def told_by(street, taken, pixels):
    """What a photo with other pixels tells of the car on the street, from where it was taken."""
    scene = standing(street, replace(car(), photos=(AssetPhoto(taken.camera, lambda: pixels),)))
    there = replace(taken.camera, world_from_cam=scene.actors[1].trajectory.world_from_body[0] @ taken.camera.world_from_cam)
    (found,) = References([], scene).along([render_frame(scene, there, READS)])
    return found


def test_of_what_a_photo_shows_in_part_only_nothing_is_told(street):
    """Half of an asset behind glass, whose colour must not count: as if that half had not been seen at all."""
    taken = photographed(painted(), 160)
    whole, glass, hidden = (taken.read().copy() for _ in range(3))
    right = slice(taken.camera.width // 2, None)
    glass[:, right, :3], glass[:, right, 3] = (255, 0, 0), (0.8 * glass[:, right, 3]).astype(np.uint8)
    hidden[:, right] = 0
    shown, dimmed, absent = (told_by(street, taken, pixels) for pixels in (whole, glass, hidden))
    assert shown.trust[:, right].max() > 0.5 and dimmed.trust[:, : right.start - 1].max() > 0.5
    assert not absent.trust[:, right.start + 1 :].any()
    assert torch.equal(dimmed.trust, absent.trust) and torch.equal(dimmed.reference, absent.reference)


def test_what_a_photos_mask_says_beyond_the_splats_does_not_count(street):
    """A mask that takes in the bright wall behind the asset: its colours would be taken for the asset's light."""
    taken = photographed(painted(), 160)
    loose = taken.read().copy()
    loose[loose[..., 3] == 0] = 255
    found, wanted = told_by(street, taken, loose), told_by(street, taken, taken.read())
    assert wanted.trust.max() > 0.5 and torch.equal(found.trust, wanted.trust) and torch.equal(found.reference, wanted.reference)


def test_exposure_and_light_of_the_photo_stay_behind(street):
    alike, truth, mine = seen(street, [photographed(painted(), d) for d in REAR])
    darker, _, _ = seen(street, [photographed(painted(), d, gain=0.6) for d in REAR])
    assert (better(darker) - better(alike)).abs()[mine].mean() < 0.01
    assert psnr(better(darker), truth, mine) > psnr(darker.rgb, truth, mine) + 2


def test_photos_from_the_other_side_say_nothing(street):
    found, _, mine = seen(street, [photographed(painted(), d) for d in (-15, 0, 15)])
    assert found.trust[mine].mean() < 0.1


def test_photos_from_another_direction_are_trusted_less(street):
    from_here, from_aside = (seen(street, [photographed(painted(), degrees)])[0].trust for degrees in (163, 195))
    both = (from_here > 0) & (from_aside > 0)
    assert both.sum() > 200 and from_aside[both].median() < 0.6 * from_here[both].median()


def test_what_is_light_all_over_an_asset_is_no_detail_at_its_rim():
    y, x = torch.meshgrid(torch.arange(40.0), torch.arange(60.0), indexing="ij")
    shows = (x - 30).square() / 25**2 + (y - 20).square() / 12**2 < 1
    light = torch.full((40, 60, 3), 0.3)
    assert _detail(light, shows).abs().max() < 1e-5
    spot = light + ((x - 30).abs() < 1)[..., None] * 0.2
    assert _detail(spot, shows)[20, 30].min() > 0.1 and not _detail(spot, shows)[~shows].any()


def test_a_photo_of_a_predicted_moment_is_not_looked_at(street):
    photos = [photographed(painted(), d) for d in REAR]
    moment = view(street).time_us
    found, _, mine = seen(street, [AssetPhoto(replace(p.camera, time_us=moment), p.read) for p in photos], predicted=[view(street)])
    assert not found.trust.any() and mine.any()


def test_what_an_asset_hides_behind_takes_nothing_of_it(street):
    asset = replace(car(), photos=tuple(photographed(painted(), d) for d in REAR))
    scene = standing(street, asset)
    before = replace(car("van", (0.2, 0.6, 0.2)), meta={"inserted": True})
    pose = standing_pose(street, torch.tensor([5.5, 1.2], dtype=torch.float64), 0.3, before.size)
    scene = replace(scene, actors=(*scene.actors, Actor(before, Trajectory(torch.tensor([0]), pose[None]), "before")))
    frame = render_frame(scene, view(scene), READS)
    (found,) = References([], scene).along([frame])
    assert (frame.instance == 3).sum() > 300 and not found.trust[frame.instance == 3].any()


def test_shares_of_photos_change_little_along_a_path(street):
    scene = standing(street, replace(painted(), photos=tuple(photographed(painted(), d) for d in range(120, 240, 12))))
    portraits = Portraits(scene.actors[1], 2, scene.model_for)
    shares = []
    for i in range(200):
        turn = np.radians(150 + 0.3 * i)
        eye = torch.tensor([8 * np.cos(turn), 8 * np.sin(turn), 0.5], dtype=torch.float64)
        share = torch.zeros(10)
        for index, value, _ in portraits._chosen(eye, 50.0, ()):
            share[index] = value
        shares.append(share)
    assert torch.stack(shares).diff(dim=0).abs().max() < 0.1


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
def test_photos_of_an_asset_say_the_same_on_a_gpu(street):
    scene = standing(street, replace(car(), photos=tuple(photographed(painted(), d) for d in REAR)))
    (here,), (there,) = (References([], s).along([render_frame(s, view(s), READS)]) for s in (scene, scene.to("cuda")))
    assert (here.trust - there.trust.cpu()).abs().mean() < 1e-3 and (better(here) - better(there).cpu()).abs().mean() < 1e-3
