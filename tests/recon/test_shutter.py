from dataclasses import replace

import numpy as np
import pytest
import torch
from randomized import gaussians
from street import START_US, rig, street

from recon.album import at_once
from recon.evaluation.report import read_out
from recon.fit.knots import Knots
from recon.fit.model import Splats
from recon.fit.motion import EGO, Motion
from recon.fit.shutter import as_read
from recon.log import Track
from recon.views.frames import Frames
from recon.views.view import View
from render import render_frame
from render.compare import psnr
from scenes import Camera, Pinhole
from scenes.lenses import Fisheye
from scenes.poses import CAM_FROM_FLU, interpolate, inverse, translation, yaw


@pytest.mark.parametrize("shutter", ["rows", "columns"])
def test_a_splat_is_where_it_was_when_its_row_was_read(shutter):
    """Each moved centre falls on the line whose moment it was moved to: p = pixel(pose(p_axis / extent) X)."""
    camera = Camera(Pinhole(300.0, 300.0, 160.0, 90.0), 320, 180, torch.eye(4, dtype=torch.float64))
    first = translation(0.0, 0.0, 6.0)
    last = translation(0.05, -0.02, -0.08) @ yaw(0.002) @ first
    splats = replace(gaussians(200), means=torch.randn(200, 3, generator=torch.Generator().manual_seed(1)) * 1.5)
    moved = as_read(splats, first, last, camera, shutter)
    middle = 0.5 * (first + last)  # the turn is too small to tell from a slerp
    pixels = camera.lens.project(moved.means.double() @ middle[:3, :3].T + middle[:3, 3])
    axis, extent = (1, 180) if shutter == "rows" else (0, 320)
    shares = (pixels[:, axis] / extent).clamp(0, 1)
    poses = interpolate(first.expand(200, 4, 4), last.expand(200, 4, 4), shares)
    truth = camera.lens.project((poses[:, :3, :3] @ splats.means.double()[..., None])[..., 0] + poses[:, :3, 3])
    torch.testing.assert_close(pixels, truth, atol=0.1, rtol=0)  # of a way of some 4 pixels
    assert (moved.means - splats.means).norm(dim=1).max() > 0.01


def test_a_scene_read_out_looks_as_the_exact_shutter_shows_it():
    scene = street()
    camera = replace(scene.rig["left_camera"], shutter="rows", readout_us=60_000)
    t = START_US + 420_000
    with torch.no_grad():
        exact = render_frame(scene, camera.along(scene.ego, t - 30_000)).rgb
        middle = scene.camera("left_camera", t)
        ours, instant = (render_frame(s, middle).rgb for s in (read_out(scene, middle, camera), scene))
    assert psnr(ours, exact) > psnr(instant, exact) + 6
    assert read_out(scene, middle, scene.rig["left_camera"]) is scene


def test_a_photo_read_row_by_row_is_brought_to_one_moment():
    scene = street()
    camera = replace(scene.rig["left_camera"], shutter="rows", readout_us=60_000)
    t = START_US + 420_000
    with torch.no_grad():
        photo = render_frame(scene, camera.along(scene.ego, t - 30_000)).rgb.clamp(0, 1)
        middle = scene.camera("left_camera", t)
        instant = render_frame(scene, middle).rgb
    assert psnr(at_once(scene, middle, camera, photo), instant) > psnr(photo, instant) + 5
    assert at_once(scene, middle, scene.rig["left_camera"], photo) is photo


def motion(readout_us=0):
    scene, times = street(), [START_US + 100_000 * i for i in range(8)]
    views = [View(0, i, t, torch.zeros(1, 1, 3), False, torch.zeros(1, 1, dtype=torch.bool)) for i, t in enumerate(times)]
    frames = Frames(["front_camera"], [(96, 54)], views)
    cameras = {"front_camera": replace(rig()["front_camera"], shutter="rows", readout_us=readout_us)}
    tracks = [
        Track(a.track, "car", True, a.asset.size.numpy(), a.trajectory.times_us.numpy(), a.trajectory.world_from_body, np.zeros(0), ())
        for a in scene.actors
    ]
    return scene, views, Motion(frames, cameras, Knots(scene.ego), tracks)


def test_a_late_clock_stands_farther_along_the_path_and_so_do_the_actors_it_sees():
    scene, views, path = motion()
    path.clocks = torch.tensor([4.0])
    shot = path.shot(views[3])
    later = scene.camera("front_camera", views[3].time_us + 4000)
    torch.testing.assert_close(shot.camera.world_from_cam, later.world_from_cam, atol=1e-6, rtol=0)
    assert torch.equal(path.camera(views[3]).world_from_cam, shot.camera.world_from_cam)
    (pose,) = shot.poses().values()
    torch.testing.assert_close(pose, scene.actors[0].trajectory.at(views[3].time_us + 4000), atol=1e-6, rtol=0)
    mount, times = path.mounted(0, [v.time_us for v in views])
    assert times.tolist() == [v.time_us + 4000 for v in views]
    torch.testing.assert_close(mount, path.rig[0].body_from_cam)


def test_corrections_move_the_camera_in_the_bodys_own_frame():
    _, views, path = motion()
    before = path.camera(views[2]).world_from_cam
    path.ego.deltas[2, 4] = 1.0  # left
    off = inverse(before) @ path.camera(views[2]).world_from_cam
    torch.testing.assert_close(off[:3, 3], torch.tensor([-EGO[1], 0, 0], dtype=torch.float64), atol=1e-9, rtol=0)


def test_a_lens_that_looks_aside_sees_the_actors_there():
    scene, views, path = motion()
    place = scene.actors[0].trajectory.at(views[3].time_us)[:3, 3]
    pose = translation(*(place - torch.tensor([40.0, 0, 0])).tolist()) @ yaw(1.4) @ inverse(CAM_FROM_FLU)
    beside = Camera(Pinhole(40.0, 40.0, 48.0, 27.0), 96, 54, pose)
    assert path.near(views[3], beside) == []
    assert path.near(views[3], replace(beside, lens=Fisheye(30.0, 30.0, 48.0, 27.0))) == [1]


def splats_of(scene):
    groups = [scene.background.gaussians, *(a.asset.gaussians for a in scene.actors)]
    return Splats.of(groups, [torch.ones(len(g)) for g in groups])


def test_a_shutter_that_takes_all_rows_at_once_moves_nothing():
    scene, views, path = motion()
    splats = splats_of(scene)
    assert path.as_read(splats, path.shot(views[3])) is splats
    _, views, path = motion(30_000)
    shot = path.shot(views[3])
    moved = path.as_read(splats, shot)
    assert all((a != b).any() for a, b in zip(*(s.fields["means"].split(s.sizes) for s in (splats, moved)), strict=True))
    assert path.as_read(splats, path.beside(shot, shot.camera)) is splats is path.as_read(splats, shot.at_once())


def test_groups_that_are_read_together_move_as_each_does_alone():
    scene, views, path = motion(30_000)
    splats, shot = splats_of(scene), path.shot(views[3], (48, 27))
    together = path.as_read(splats, shot).groups(splats.fields["sh"].shape[1])
    assert len(together) > 1 and set(shot.actors) == set(range(1, len(together)))
    for k, (group, moved) in enumerate(zip(splats.groups(splats.fields["sh"].shape[1]), together, strict=True)):
        alone = as_read(group, *shot.read[:, k], shot.camera, "rows")
        torch.testing.assert_close(moved.means, alone.means, atol=0, rtol=0)
