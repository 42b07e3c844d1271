"""Cameras that look elsewhere than recorded are turned until what they show of lidar's surfaces meets."""

import io
import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage

from recon.log import LidarPoints, Log, LogCamera, Packed, Sweep, Track
from recon.registration.corrected import TURNED, as_corrected
from recon.registration.mounts_by_surfaces import _improved, mounts_by_surfaces
from recon.registration.patches import CameraPictures, Matches, _sampled
from scenes.lenses import Pinhole
from scenes.poses import inverse, small_poses, translation
from scenes.trajectory import Trajectory

COUNT, STEP_US, SPEED = 12, 100_000, 10.0
WIDTH, HEIGHT, FOCAL = 480, 320, 300.0
ALL = (-STEP_US, COUNT * STEP_US)
STILL = (0.0,) * 6
LENS = Pinhole(FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2)
PLANES = (((0, 0, 0), (0, 0, 1)), ((0, 7, 0), (0, 1, 0)), ((0, -5, 0), (0, 1, 0)), ((34, 0, 0), (1, 0, 0)))
"""A point and the normal of each: the road, house fronts at both sides, and one where the street ends."""


def test_a_picture_is_sampled_at_the_middles_of_its_pixels():
    across, down = np.meshgrid(np.arange(8.0), np.arange(6.0))
    assert _sampled(across + 10 * down, np.array([[0.5, 0.5], [3.5, 2.5], [3.75, 2.5], [-2.0, 2.5]])).tolist() == [0, 23, 23.25, 0]


def test_a_pixel_is_transferred_from_where_its_row_was_read_to_where_it_is_read_again():
    """A camera that goes to its right at 10 m/s past a wall 10 m away; what a row at 3/4 shows was read 25 ms late."""
    times = torch.tensor([-100_000, 0, 200_000, 300_000])
    poses = torch.stack([translation(1e-5 * t, 0.0, 0.0) for t in times.tolist()])
    ego, files = Trajectory(times, poses), (Path("none"),) * 2
    camera = LogCamera("aside", Pinhole(100.0, 100.0, 100.0, 50.0), 200, 100, files, times[1:3], poses[1:3], "rows", 100_000)
    pictures = CameraPictures(SimpleNamespace(ego=ego), camera, np.zeros(0), lambda _: None, 1)
    wall, normal = np.array([[3.0, 1.0, 10.0]]), np.array([[0.0, 0.0, 1.0]])
    pixels = np.array([[[100.0, 75.0], [100.0, 25.0]]])
    np.testing.assert_allclose(pictures._transferred(0, 1, pixels, wall, normal, np.zeros(7)), [[[80, 75], [80, 25]]], atol=1e-6)


def test_what_no_patch_tells_is_likely_to_be_as_recorded():
    silent = Matches(np.zeros((5, 2, 7)), np.zeros((5, 2)), np.tile(np.eye(2), (5, 1, 1)), np.zeros((5, 2, 7)))
    np.testing.assert_allclose(_improved([silent], np.full(7, 0.1))[0], 0, atol=1e-12)


@lru_cache
def paint(plane: int) -> np.ndarray:
    """Brightness of a plane's cells, 0.15 m wide, from 20 m before its point on."""
    return ndimage.gaussian_filter(np.random.default_rng(plane).uniform(0, 255, (500, 500)), 0.7).astype(np.float32)


def axes(normal: tuple) -> np.ndarray:
    """The two coordinates `[2, 3]` that a plane is painted along."""
    return np.eye(3)[[k for k in range(3) if not normal[k]]]


def mount() -> torch.Tensor:
    """How the camera is recorded to be fixed to the car: 1.6 m above the road, looking along it and a little aside."""
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3] = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)
    pose[:3, 3] = torch.tensor([0, 0.3, 1.6])
    return pose @ small_poses(torch.tensor([0.0, 0.1, 0, 0, 0, 0]))


def path() -> Trajectory:
    """The car's, which weaves a little."""
    times = torch.arange(-1, COUNT + 1) * STEP_US
    turns = torch.zeros(len(times), 6)
    turns[:, 2] = 0.02 * torch.sin(times * 8e-6)
    body = small_poses(turns)
    body[:, 0, 3] = SPEED * 1e-6 * times.double()
    return Trajectory(times, body)


def photo(pose: np.ndarray, readout_us: int) -> bytes:
    """A PNG of the street from a pose, rows read from top to bottom."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays = np.stack([(u - LENS.cx) / FOCAL, (v - LENS.cy) / FOCAL, np.ones_like(u)], -1) @ pose[:3, :3].T
    eye = pose[:3, 3] + SPEED * 1e-6 * ((v / HEIGHT - 0.5) * readout_us)[..., None] * [1, 0, 0]
    nearest, grey = np.full(u.shape, 1e9), np.full(u.shape, 128.0)
    for k, (point, normal) in enumerate(PLANES):
        far = ((point - eye) @ normal) / np.where(np.abs(rays @ normal) > 1e-9, rays @ normal, 1e-9)
        on = (eye + rays * far[..., None]) @ axes(normal).T
        shown = ndimage.map_coordinates(paint(k), [(on[..., i] + 20) / 0.15 for i in (0, 1)], order=1, mode="wrap")
        first = (far > 0) & (far < nearest)
        nearest, grey = np.where(first, far, nearest), np.where(first, shown, grey)
    stored = io.BytesIO()
    Image.fromarray(grey.round().clip(0, 255).astype(np.uint8)).convert("RGB").save(stored, "png")
    return stored.getvalue()


def truth(off: tuple[float, ...], late_us: int = 0) -> torch.Tensor:
    """Where the camera is at its frames' times, `[F, 4, 4]`, if it is fixed by a small motion otherwise than recorded and so late."""
    return path().near_each(torch.arange(COUNT) * STEP_US + late_us) @ mount() @ small_poses(torch.tensor(off))


def drive(off: tuple[float, ...] = STILL, late_us: int = 0, readout_us: int = 0) -> Log:
    """A log whose camera is so far off."""
    times, ego = torch.arange(COUNT) * STEP_US, path()
    files = tuple(Packed("a.png", lambda pose=pose: photo(pose, readout_us)) for pose in truth(off, late_us).numpy())
    shutter = "rows" if readout_us else "global"
    camera = LogCamera("front", LENS, WIDTH, HEIGHT, files, times, truth(STILL), shutter, readout_us)
    generator, sweeps = np.random.default_rng(4), []
    for i, time in enumerate(times.tolist()):
        x = SPEED * 1e-6 * time
        parts = [generator.uniform((x - 5, -5, 0), (34, 7, 0), (4000, 3))]
        parts += [generator.uniform((x - 5, y, 0), (34, y, 6), (4000, 3)) for y in (7, -5)]
        xyz = np.concatenate([*parts, generator.uniform((34, -5, 0), (34, 7, 6), (2000, 3))])
        points = LidarPoints(xyz + generator.normal(0, 0.01, xyz.shape), np.full(len(xyz), time), np.zeros(len(xyz), np.int64))
        sweeps.append(Sweep(i, time, lambda points=points: points))
    return Log("made", "made", {"front": camera}, tuple(sweeps), (), ego, {})


def left_off(log: Log, off: tuple[float, ...], late_us: int = 0) -> np.ndarray:
    """By what a log's camera still differs from where it is: radians and metres `[6]`, to their first order, at the worst of its frames."""
    rest = (inverse(log.camera("front").world_from_cam) @ truth(off, late_us)).numpy()
    return np.abs(np.stack([rest[:, 2, 1], rest[:, 0, 2], rest[:, 1, 0], *rest[:, :3, 3].T], 1)).max(0)


@pytest.fixture(autouse=True)
def few(monkeypatch):
    """Of a street that is all surfaces, less has to be looked at."""
    monkeypatch.setattr("recon.registration.mounts_by_surfaces.PAIRS", 6)
    monkeypatch.setattr("recon.registration.patches.PATCHES", 60)


@pytest.mark.parametrize(
    ("off", "late_us"),
    [((0, 0.0131, 0, 0, 0, 0), 0), ((-0.008, 0.006, 0.008, 0.05, 0.05, 0), 0), (STILL, -40_000)],
    ids=["aside", "of all a little", "early"],
)
def test_a_camera_that_looks_elsewhere_is_turned_back(off, late_us, capsys):
    log, reports = drive(off, late_us), []
    better = mounts_by_surfaces(log, ["front"], log.sweeps, ALL, lambda: reports.append(1))
    rest = left_off(better, off, late_us)
    assert rest[:2].max() < 0.002 and rest[3:5].max() < 0.02, "where it looks, and stands"
    assert rest[2] < 0.004 and rest[5] < 0.1, "what so few tell less well"
    assert abs(int(better.camera("front").times_us[0]) - late_us) < 10_000
    assert "front is taken turned by 0." in capsys.readouterr().err and len(reports) == 1
    assert mounts_by_surfaces(better, ["front"], better.sweeps, ALL) is better, "where its pictures meet"
    again = as_corrected(log, json.loads(json.dumps(better.meta)))
    assert torch.equal(again.camera("front").world_from_cam, better.camera("front").world_from_cam)
    assert torch.equal(again.camera("front").times_us, better.camera("front").times_us)
    assert again.meta[TURNED] == better.meta[TURNED]


def test_what_a_fit_copes_with_is_left_to_it():
    log = drive((0.0, 0.004, 0.0, 0.0, 0.0, 0.0))
    assert mounts_by_surfaces(log, ["front"], log.sweeps, ALL) is log


@pytest.mark.parametrize("readout_us", [0, 60_000])
def test_a_camera_that_looks_as_recorded_is_left_alone(readout_us, capsys):
    """However its rows are read."""
    log = drive(readout_us=readout_us)
    assert mounts_by_surfaces(log, ["front"], log.sweeps, ALL) is log and not capsys.readouterr().err


def test_pictures_that_meet_nowhere_tell_nothing():
    """Poses that shake are no wrong mount."""
    log = drive((0.0, 0.0087, 0.0, 0.0, 0.0, 0.0))
    shaken = torch.from_numpy(np.random.default_rng(1).normal(0, (0.003,) * 3 + (0.1,) * 3, (COUNT, 6)))
    camera = replace(log.camera("front"), world_from_cam=log.camera("front").world_from_cam @ small_poses(shaken))
    log = replace(log, cameras={"front": camera})
    assert mounts_by_surfaces(log, ["front"], log.sweeps, ALL) is log


def test_where_nothing_tells_nothing_is_turned():
    log = drive((0.0, 0.0087, 0.0, 0.0, 0.0, 0.0))
    assert mounts_by_surfaces(log, ["front"], (), ALL) is log, "no lidar"
    assert mounts_by_surfaces(log, ["front"], log.sweeps, (0, 100_000)) is log, "it has hardly moved"
    behind = replace(log, sweeps=tuple(replace(s, time_us=s.time_us + 10_000_000) for s in log.sweeps))
    assert mounts_by_surfaces(log, ["front"], behind.sweeps, ALL) is log, "no sweep was taken then"
    here = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    around = Track("veh_1", "truck", True, np.array([200.0, 200.0, 20.0]), np.array(ALL), here, np.array([-1, -1]), ())
    assert mounts_by_surfaces(replace(log, tracks=(around,)), ["front"], log.sweeps, ALL).meta == {}, "all of it moves along"
