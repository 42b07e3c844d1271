from dataclasses import replace

import torch
from randomized import gaussians
from street import START_US, street

from recon.fit.model import Splats, draw
from recon.fit.sight import in_sight
from scenes import Camera, Pinhole, Placed
from scenes.lenses import Fisheye
from scenes.poses import inverse, translation, yaw

EYE = torch.eye(4, dtype=torch.float64)


def world(count=4000):
    spread = 8 * torch.randn(count, 3, generator=torch.Generator().manual_seed(4))
    made = replace(gaussians(count).with_sh_count(1), means=spread)
    return Splats.of([replace(made, log_scales=0.3 * made.log_scales - 2)], [torch.ones(count)])


def camera(pose=EYE):
    return Camera(Pinhole(90.0, 90.0, 48.0, 27.0), 96, 54, pose)


def test_what_is_left_out_shows_in_no_picture():
    splats = world()
    for pose in (EYE, translation(3.0, 1.0, -5.0) @ yaw(2.0)):
        back = inverse(pose)
        which = in_sight(splats, [(camera(pose), back, back)], [])
        assert 0 < len(which) < 0.5 * len(splats) and (which.diff() > 0).all()
        (whole,), (part,) = (draw([Placed(s.groups(1)[0].detach(), EYE)], camera(pose), "rgb") for s in (splats, splats.select(which, 1)))
        assert torch.equal(whole, part)


def test_all_that_a_moving_readout_and_a_second_eye_may_see_is_in():
    splats, last = world(), translation(0.5, 0.0, 0.3)
    turned = translation(0.0, 0.0, 2.0) @ yaw(1.0)
    both = in_sight(splats, [(camera(), EYE, inverse(last)), (camera(turned), *[inverse(turned)] * 2)], [])
    for pose in (EYE, last, turned):
        alone = in_sight(splats, [(camera(pose), *[inverse(pose)] * 2)], [])
        assert torch.isin(alone, both).all()


def test_groups_are_in_sight_whole_or_not_at_all():
    scene = street()
    parts = [scene.background.gaussians, *(a.asset.gaussians for a in scene.actors), gaussians(30).with_sh_count(1)]
    splats = Splats.of([p.with_sh_count(1) for p in parts], [torch.ones(len(p)) for p in parts])
    there = scene.camera("front_camera", START_US)
    which = in_sight(splats, [(there, *[inverse(there.world_from_cam)] * 2)], [2])
    shown = splats.select(which, 1)
    assert shown.sizes[1:] == [0, 30] and 0 < shown.sizes[0] <= splats.sizes[0] and len(shown.groups(1)) == 3
    assert torch.equal(shown.groups(1)[2].means, splats.groups(1)[2].means)


def test_a_lens_that_sees_beside_itself_sees_everything():
    fisheye = Fisheye(30.0, 30.0, 48.0, 27.0)
    assert len(in_sight(world(), [(replace(camera(), lens=fisheye), EYE, EYE)], [])) == 4000
