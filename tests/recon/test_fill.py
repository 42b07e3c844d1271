from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from recon.seeds.fill import FAR, unexplained
from recon.seeds.sweep import companions, swept_depth
from recon.views.skies import HIDDEN, SkyPicture, always_hidden, cells, finer, like_sky, seen_sky, sky_mask
from recon.views.view import View
from scenes import Camera, Gaussians, Pinhole, Placed, RigCamera, Scene, Sky, Trajectory
from scenes.ground import Ground

GREY = np.full(3, 0.5)
DEEP = Ground(torch.full((2, 2), -40.0), (0.0, 0.0), 1.0)


def house_under_sky():
    image = np.full((60, 80, 3), (140, 160, 200), np.uint8)
    image[25:, 20:60] = (150, 120, 90)
    image[40:] = (80, 80, 80)
    return image


def camera():
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return Camera(Pinhole(60.0, 60.0, 40.0, 30.0), 80, 60, pose)


def test_a_sky_of_which_hardly_anything_was_seen_takes_that_everywhere():
    sky = SkyPicture(64, GREY)
    sky.count[20, 30], sky.sum[20, 30] = 1, (0.2, 0.4, 0.6)
    np.testing.assert_allclose(sky.picture(), np.broadcast_to(np.float32([0.2, 0.4, 0.6]), (64, 128, 3)), atol=1e-4)


def test_a_sky_spreads_across_the_seam_behind():
    sky = SkyPicture(64, GREY)
    for column, rgb in ((1, (1.0, 0.0, 0.0)), (64, (0.0, 0.0, 1.0))):
        sky.count[20, column], sky.sum[20, column] = 1, rgb
    red, _, blue = sky.picture()[20, 124]
    assert red > 0.9 and blue < 0.1


def test_a_sky_has_no_edge_where_it_was_not_seen():
    sky = SkyPicture(64, GREY)
    for rows, columns, rgb in ((slice(16, 30), slice(20, 40), (0.2, 0.4, 0.8)), (slice(20, 31), slice(80, 90), (0.9, 0.8, 0.6))):
        sky.count[rows, columns], sky.sum[rows, columns] = 30, np.multiply(rgb, 30)
    picture, seen = sky.picture(), torch.from_numpy(sky.count > 0)
    for step in (picture.diff(dim=0)[~(seen[1:] | seen[:-1])], picture.diff(dim=1)[~(seen[:, 1:] | seen[:, :-1])]):
        assert step.abs().max() < 0.06
    assert (picture[seen] - torch.tensor([0.2, 0.4, 0.8])).abs().amax(-1).lt(1e-4).any()
    assert (picture[0] - picture[0].mean(0)).abs().max() < 0.02  # all of the top row looks up
    above, between = picture[12, 30], picture[24, 60]
    assert above[2] > above[0] + 0.4 and 0.3 < between[0] < 0.8


def test_sky_is_what_is_smooth_and_blue_down_from_the_top():
    image = house_under_sky()
    mask = sky_mask(image)
    assert mask[2:20].all() and not mask[28:, 22:58].any() and not mask[42:].any()


def test_gaps_that_look_like_the_sky_beside_them_are_sky():
    image = house_under_sky()
    image[10:20, 30:34] = (40, 60, 30)
    image[14:16, 31:33] = (138, 160, 205)
    sky = sky_mask(image)
    sky[8:22, 28:36] = False
    assert like_sky(image, sky)[5:8].all() and not like_sky(image, sky)[11:13, 31:33].any()
    assert not like_sky(image, np.zeros(image.shape[:2], bool)).any()


def test_the_sky_picture_shows_what_was_seen_and_spreads_it():
    sky = SkyPicture(32, GREY)
    image = house_under_sky()
    sky.add(image / 255, sky_mask(image), camera(), np.array([0.5, 1.0, 1.0]))
    picture = sky.picture()
    assert picture.shape == (32, 64, 3) and torch.isfinite(picture).all()
    np.testing.assert_allclose(picture[0, 0], [140 / 255 / 0.5, 160 / 255, 200 / 255], atol=1e-3)
    dark = SkyPicture(8, np.array([0.1, 0.2, 0.3])).picture()
    torch.testing.assert_close(dark, torch.tensor([0.1, 0.2, 0.3]).expand(8, 16, 3))


def test_the_upper_part_of_a_house_stands_where_its_foot_stands():
    image = torch.from_numpy(house_under_sky())
    alpha = np.zeros((60, 80))
    alpha[35:] = 1
    depth = np.where(alpha > 0, 12.0, np.inf)
    sky = np.zeros((60, 80), bool)
    sky[:25] = True
    view = View(0, 0, 0, image, False, torch.zeros(60, 80, dtype=torch.bool))
    cloud, width = unexplained(view, camera(), alpha, depth, sky, np.ones(3), DEEP, [])
    assert len(cloud.xyz) > 10 and np.abs(cloud.xyz[:, 0] - 12).max() < 1e-6 and (cloud.xyz[:, 2] > -2).all()
    assert (width > 0).all()
    eaves = (cloud.xyz[:, 2] > cloud.xyz[:, 2].max() - 1e-6) & (np.abs(cloud.xyz[:, 1]) < 2)  # a row of their pixels is sky
    assert eaves.any()
    np.testing.assert_allclose(cloud.rgb[eaves], np.broadcast_to(np.array([150, 120, 90]) / 255, (eaves.sum(), 3)), atol=1e-6)
    gain = np.array([2.0, 1.0, 0.5])  # of a camera that shows red twice as bright as it is
    np.testing.assert_allclose(unexplained(view, camera(), alpha, depth, sky, gain, DEEP, [])[0].rgb, cloud.rgb / gain, atol=1e-6)
    nothing = unexplained(view, camera(), np.zeros((60, 80)), np.full((60, 80), np.inf), sky, np.ones(3), DEEP, [])[0]
    up = nothing.xyz[:, 2] > 0
    assert np.abs(nothing.xyz[up, 0] - FAR).max() < 1e-6 and np.abs(nothing.xyz[:, 2].min() + 40) < 1e-6


@pytest.mark.parametrize("rise", [-0.12, 0.0, 0.08])
def test_what_fills_gaps_lies_on_the_street_however_that_falls_and_never_under_it(rise):
    """A camera 1.5 m above a street; nothing is explained but its lowest rows, said to be far away."""
    street = Ground((rise * torch.arange(0, 101.0)).expand(2, 101).contiguous(), (0.0, -50.0), 1.0)
    pose = camera().world_from_cam.clone()
    pose[2, 3] = 1.5
    high = replace(camera(), world_from_cam=pose)
    image = torch.full((60, 80, 3), 90, dtype=torch.uint8)
    view = View(0, 0, 0, image, False, torch.zeros(60, 80, dtype=torch.bool))
    alpha = np.zeros((60, 80))
    alpha[54:] = 1
    depth = np.where(alpha > 0, 90.0, np.inf)
    cloud, _ = unexplained(view, high, alpha, depth, np.zeros((60, 80), bool), np.ones(3), street, [])
    falls = (cloud.xyz[:, 2] - 1.5) / cloud.xyz[:, 0]
    over = cloud.xyz[:, 2] - rise * cloud.xyz[:, 0]
    meets = falls < min(rise - 1.5 / 90, -1e-3)
    assert meets.sum() > 20 and np.abs(over[meets]).max() < 1e-6
    assert np.abs(cloud.xyz[~meets, 0] - 90).max() < 1e-6


def test_what_stands_far_behind_a_house_is_found_there_by_other_pictures():
    """A striped tower 300 m away shows above a house 12 m away: from 8 m nearer it is nearly as large, which the house would not be."""

    def seen_from(x: float) -> tuple[View, Camera]:
        at = camera()
        pose = at.world_from_cam.clone()
        pose[0, 3] = x
        at = replace(at, world_from_cam=pose)
        rays = at.lens.unproject(at.pixel_centres())
        height = -rays[..., 1] * (300 - x)
        stripes = 128 + 100 * torch.sin(height / 3) * torch.cos(rays[..., 0] * (300 - x) / 4)
        image = torch.where((height > 20)[..., None], stripes[..., None].expand(-1, -1, 3), torch.tensor(120.0))
        return View(0, int(x), 0, image.clamp(0, 255).byte(), False, torch.zeros(60, 80, dtype=torch.bool)), at

    views = [seen_from(x) for x in (0.0, 4.0, 8.0)]
    found = companions(views[0][0], [v for v, _ in views], np.array([0.0, 4.0, 8.0]))
    assert found == [views[2][0]]
    pixels = torch.tensor([[x, 14.5] for x in np.arange(20.5, 60, 3)])
    depth = swept_depth(pixels, np.full(len(pixels), 12.0), 2.0, *views[0], views[2:])
    assert np.median(depth) > 90
    assert (swept_depth(pixels, np.full(len(pixels), 12.0), 2.0, *views[0], []) == 12).all()


def test_a_sky_that_something_always_hid_is_spread_from_where_it_was_seen():
    """A wall before the left half of the view, noise behind it: of the noise nothing stays, of what was seen everything."""
    y, z = torch.meshgrid(torch.arange(0.3, 12, 0.5), torch.arange(-8, 8, 0.5), indexing="ij")
    means = torch.stack([torch.full_like(y, 10.0), y, z], -1).reshape(-1, 3).float()
    n = len(means)
    wall = Gaussians(
        means, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 3), -1.0), torch.full((n,), 6.0), torch.zeros(n, 1, 3)
    )
    still = torch.eye(4, dtype=torch.float64)
    ego = Trajectory(torch.tensor([0, 100_000]), still.repeat(2, 1, 1))
    rig = {"front": RigCamera(camera().lens, 80, 60, camera().world_from_cam)}
    noise = torch.rand(64, 128, 3, generator=torch.Generator().manual_seed(1))
    blue = torch.tensor([0.2, 0.4, 0.8])
    looked = torch.zeros(64, 128, dtype=torch.bool)
    looked[26:38, 52:64] = True  # 34 degrees to the left of +x and as much up and down as the wall covers
    sky = Sky(torch.where(looked[..., None], noise, blue))
    nowhere = torch.zeros(HIDDEN, 2 * HIDDEN, dtype=torch.bool)
    seen = seen_sky(Scene(Placed(wall, still), (), sky, ego, rig), nowhere).linear
    assert (seen[looked] - blue).abs().max() < 1e-3
    assert (seen[26:38, 66:72] - blue).abs().max() < 1e-5
    open_ = Scene(Placed(wall.select(torch.zeros(0, dtype=torch.long)), still), (), sky, ego, rig)
    assert (seen_sky(open_, nowhere).linear[looked] - noise[looked]).abs().max() < 1e-5, "with no wall all of it was seen"
    there = torch.nn.functional.max_pool2d(looked[None, None].float(), 3, 1, 1)[0, 0] > 0
    told = seen_sky(open_, finer(there, HIDDEN)).linear
    assert (told[looked] - blue).abs().max() < 1e-3, "with no splats before it, but of which photos say that it never shows"


def test_a_sky_that_shines_through_in_few_looks_was_not_seen(monkeypatch):
    """In one of 30 all of it, on the left; on the right in two of 30."""
    left, right = np.zeros((2, 60, 80), bool)
    left[:, :40], right[:, 40:] = True, True
    looks = [left | right, right, *28 * [left & right]]
    monkeypatch.setattr("recon.views.skies.looks_of", lambda _: [(look, camera()) for look in looks])
    own = torch.zeros(64, 128, 3)
    own[:, :64, 0], own[:, 64:, 2] = 1, 1  # red on the left, blue on the right
    nowhere = torch.zeros(HIDDEN, 2 * HIDDEN, dtype=torch.bool)
    seen = seen_sky(SimpleNamespace(sky=Sky(own)), nowhere).linear
    assert (seen - torch.tensor([0.0, 0.0, 1.0])).abs().max() < 1e-5


def test_directions_in_which_no_look_shows_the_sky_are_known():
    """Two looks ahead: one past a house on the left, one that a bus hides from there on to the right."""
    first, second = np.zeros((2, 60, 80), bool)
    first[:30, 30:] = True
    second[:30, :20] = True
    hidden = always_hidden([(first, camera()), (second, camera())])
    rays = camera().lens.unproject(torch.tensor([[25.5, 12.5], [10.5, 12.5], [60.5, 12.5], [40.5, 50.5], [31.5, 28.5]]))
    ahead = rays.double() @ camera().world_from_cam[:3, :3].T
    assert hidden[cells(ahead, HIDDEN)].tolist() == [True, False, False, True, False]
    assert not hidden[cells(-ahead, HIDDEN)].any(), "nobody looked back"
