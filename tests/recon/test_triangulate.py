from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from recon.colmap import CAM_FROM_BODY, colmap_lens, lens_of
from recon.frames import View, load_frames
from recon.log import Log, LogCamera, Packed, Track
from recon.project import project
from recon.sfm import ModelCamera
from recon.sparse import cloud_from_points
from recon.triangulate import matched, triangulated
from render.rays import world_directions
from scenes.camera import Camera
from scenes.lenses import Fisheye, FTheta, OpenCV, Pinhole
from scenes.poses import inverse, translation, yaw
from scenes.trajectory import Trajectory

ALL = (0, 10**18)
SIZE = (320, 180)
HEIGHT, WALL = 1.5, 20.0
"""Metres from the cameras down to the ground, and from the first one ahead to a wall."""

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")


def _depth(camera: Camera) -> torch.Tensor:
    """float64 `[H, W]` of the ground and the wall."""
    rays = world_directions(camera).double()
    eye = camera.world_from_cam[:3, 3]
    ground = torch.where(rays[..., 2] < 0, -eye[2] / rays[..., 2], torch.inf)
    wall = torch.where(rays[..., 0] > 0, (WALL - eye[0]) / rays[..., 0], torch.inf)
    return torch.minimum(ground, wall)


def _picture(camera: Camera, blotches: torch.Tensor) -> Packed:
    """Both painted with blotches of a third of a metre."""
    rays, depth = world_directions(camera).double(), _depth(camera)
    at = camera.world_from_cam[:3, 3] + rays * depth[..., None]
    plane = torch.where((at[..., 2] < 1e-6)[..., None], at[..., :2], at[..., 1:] + 50)
    image = torch.nn.functional.grid_sample(blotches, (plane[None] / 100).float(), padding_mode="reflection", align_corners=False)
    buffer = BytesIO()
    Image.fromarray((image[0].permute(1, 2, 0) * 255).byte().numpy()).save(buffer, "png")
    return Packed("painted", buffer.getvalue)


@pytest.fixture(scope="module")
def bare():
    """A drive of two cameras and no lidar towards a wall."""
    blotches = torch.rand(1, 3, 600, 600, generator=torch.Generator().manual_seed(0))
    lens, times = Pinhole(160, 160, 160, 90), torch.arange(9) * 100_000
    bodies = torch.stack([translation(0.6 * i, 0.05 * i, HEIGHT) for i in range(9)])
    cameras = {}
    for name, turn in (("front", 0.0), ("left", 0.5)):
        poses = bodies @ yaw(turn) @ torch.from_numpy(np.linalg.inv(CAM_FROM_BODY))
        views = [Camera(lens, *SIZE, pose) for pose in poses]
        cameras[name] = LogCamera(name, lens, *SIZE, tuple(_picture(v, blotches) for v in views), times, poses)
    return Log("bare", Path("bare"), cameras, (), (), Trajectory(times, bodies), {}, ("front", "left"))


@pytest.fixture(scope="module")
def found(bare):
    frames = load_frames(bare, list(bare.cameras), ALL, SIZE, 8)
    return frames, triangulated(bare, frames)


def test_points_of_a_drive_without_lidar_stand_where_it_shows_them(bare, found):
    frames, points = found
    off = []
    for view in frames.training():
        name = frames.names[view.camera]
        camera = bare.camera(name).camera(view.index, *SIZE)
        row, column, z, inside = project(points.xyz[points.seen[name][view.index]], inverse(camera.world_from_cam).numpy(), camera)
        assert inside.all()
        off.append(np.abs(z / _depth(camera).numpy()[row, column] - 1))
    assert len(points.xyz) > 500 and sum(map(len, off)) > 3 * len(points.xyz)
    assert np.median(np.concatenate(off)) < 0.01


def test_pictures_held_out_show_no_points_and_seeds_keep_off_movers(bare, found):
    frames, points = found
    assert [len(points.seen[frames.names[v.camera]][v.index]) for v in frames.held_out()] == [0, 0, 0, 0]
    free = cloud_from_points(bare, frames, points, [])
    ahead = translation(10.0, 0.0, 0.0).expand(9, 4, 4)
    car = Track("veh_1", "car", True, np.array([4.0, 2.0, 1.5]), np.arange(9) * 100_000, ahead, np.zeros(9), ())
    kept = cloud_from_points(bare, frames, points, [car])
    assert 0.5 * len(free.xyz) < len(kept.xyz) < len(free.xyz)


def test_pictures_are_matched_with_the_next_ones_and_with_those_of_their_moment():
    nothing = torch.zeros(0)
    views = [View(c, i, 100_000 * i + 10_000 * c, nothing, False, nothing) for c in range(2) for i in range(4)]
    pairs = matched(views)
    assert {(0, 1), (0, 2), (4, 5), (0, 4), (3, 7)} <= set(pairs) and len(pairs) == len(set(pairs)) == 2 * (3 + 2) + 4
    assert (3, 4) not in pairs and (0, 3) not in pairs


def test_lenses_go_to_colmap_and_back(tmp_path):
    place = 50, 51, 48, 27
    for lens in (Pinhole(*place), OpenCV(*place, 0.1, 0.01, 1e-3, 2e-3, 0.02, 0.1, 0.03, 0.01), Fisheye(*place, 0.1)):
        model, params = colmap_lens(lens, tmp_path)
        assert lens_of(ModelCamera(model, 96, 54, params), tmp_path) == lens
    with pytest.raises(ValueError, match="no lidar, and COLMAP.* no lens opencv with thin prisms"):
        colmap_lens(OpenCV(*place, s1=0.1), tmp_path)
    with pytest.raises(ValueError, match="no lens ftheta"):
        colmap_lens(FTheta(48, 27, 60.0), tmp_path)
