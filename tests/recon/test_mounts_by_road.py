"""Cameras whose pictures of the road do not meet are moved and tilted until they do."""

import io
import json
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
import torch
from PIL import Image
from scipy import ndimage

from recon.log import LidarPoints, Log, LogCamera, Packed, Sweep
from recon.registration.corrected import REMOUNTED, as_corrected
from recon.registration.mounts_by_road import mounts_by_road
from scenes.lenses import Pinhole
from scenes.trajectory import Trajectory

COUNT, STEP_US, SPEED, HEIGHT = 16, 100_000, 8.0, 2.0
WIDTH, HEIGHT_PX, FOCAL = 560, 420, 600.0
ALL = (0, COUNT * STEP_US)
CELL = 0.2


@lru_cache
def paint() -> np.ndarray:
    """What is painted on the road, from 10 m behind the start on and 10 m to either side, brightness of cells."""
    return ndimage.gaussian_filter(np.random.default_rng(3).uniform(0, 255, (400, 100)), 0.6).astype(np.float32)


def photo(x: float, height: float, tilt: float, readout_us: int) -> bytes:
    """A PNG of the road from a place `x` along it, looking along it and down by `tilt` radians, rows read from top to bottom."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT_PX) + 0.5)
    down, left = (v - HEIGHT_PX / 2) / FOCAL, -(u - WIDTH / 2) / FOCAL
    ahead, down = np.cos(tilt) - down * np.sin(tilt), np.sin(tilt) + down * np.cos(tilt)
    far = height / np.maximum(down, 1e-3)
    along = x + SPEED * 1e-6 * (v / HEIGHT_PX - 0.5) * readout_us + far * ahead
    grey = ndimage.map_coordinates(paint(), [(along + 10) / CELL - 0.5, (far * left + 10) / CELL - 0.5], order=1, mode="nearest")
    stored = io.BytesIO()
    Image.fromarray(np.where(down > 0.02, grey, 128).astype(np.uint8)).convert("RGB").save(stored, "png")
    return stored.getvalue()


def drive(height: float = HEIGHT, tilt: float = 0.0, readout_us: int = 0, wall: bool = False) -> Log:
    """A log of a bare road whose front camera is recorded at `HEIGHT` and level; wall: one stands 4 m before the car all the way."""
    times = torch.arange(COUNT) * STEP_US
    body = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    body[:, 0, 3] = SPEED * 1e-6 * times.double()
    turn = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)
    seen = body.clone()
    seen[:, :3, :3], seen[:, 2, 3] = turn, HEIGHT
    files = tuple(Packed(f"{i}.png", lambda x=float(x): photo(x, height, tilt, readout_us)) for i, x in enumerate(body[:, 0, 3]))
    lens = Pinhole(FOCAL, FOCAL, WIDTH / 2, HEIGHT_PX / 2)
    camera = LogCamera("front", lens, WIDTH, HEIGHT_PX, files, times, seen, "rows" if readout_us else "global", readout_us)
    generator = np.random.default_rng(4)
    sweeps = []
    for i, x in enumerate(body[:, 0, 3].tolist()):
        xyz = np.concatenate([generator.uniform((x - 30, -9, 0), (x + 30, 9, 0), (6000, 3)), np.zeros((0, 3))])
        if wall:
            xyz = np.concatenate([xyz, generator.uniform((x + 4, -5, 0), (x + 4.2, 5, 1.5), (500, 3))])
        points = LidarPoints(xyz + generator.normal(0, 0.01, xyz.shape), np.full(len(xyz), int(times[i])), np.zeros(len(xyz), np.int64))
        sweeps.append(Sweep(i, int(times[i]), lambda points=points: points))
    return Log("made", "made", {"front": camera}, tuple(sweeps), (), Trajectory(times, body), {})


def lies(log: Log) -> tuple[float, float]:
    """How the camera's poses differ from where `drive` records them: metres higher, radians farther up."""
    higher, turned = (log.camera("front").world_from_cam - drive().camera("front").world_from_cam)[7, 2, 2:].tolist()
    return turned, higher


@pytest.mark.parametrize("off", [-0.08, 0.08])
def test_a_camera_that_is_recorded_too_high_or_low_is_moved(off, capsys):
    log, reports = drive(HEIGHT + off), []
    better = mounts_by_road(log, ["front"], log.sweeps, ALL, lambda: reports.append(1))
    metres, radians = lies(better)
    assert 0.5 < metres / off < 1.3 and abs(radians) < 0.002, "by far the most is its height"
    assert float((better.camera("front").world_from_cam - log.camera("front").world_from_cam).std(0).max()) < 1e-12, "all the way"
    assert torch.equal(better.ego.world_from_body, log.ego.world_from_body)
    assert f"cm {'higher' if off > 0 else 'lower'} and" in capsys.readouterr().err and len(reports) == 1
    assert mounts_by_road(better, ["front"], better.sweeps, ALL) is better, "where its pictures meet"
    again = as_corrected(log, json.loads(json.dumps(better.meta)))
    assert torch.equal(again.camera("front").world_from_cam, better.camera("front").world_from_cam)
    assert {name: tuple(off) for name, off in again.meta[REMOUNTED].items()} == better.meta[REMOUNTED]


@pytest.mark.parametrize("down", [0.004, -0.004])
def test_a_camera_that_is_tilted_is_tilted_back(down):
    """By as much as is likely: the rest is taken for height."""
    log = drive(tilt=down)
    better = mounts_by_road(log, ["front"], log.sweeps, ALL)
    metres, radians = lies(better)
    assert 0.3 < -radians / down < 1.1 and abs(metres) < 0.06
    assert mounts_by_road(better, ["front"], better.sweeps, ALL) is better


@pytest.mark.parametrize("readout_us", [0, -100_000])
def test_a_camera_that_stands_as_recorded_is_left_alone(readout_us, capsys):
    log = drive(readout_us=readout_us)
    assert mounts_by_road(log, ["front"], log.sweeps, ALL) is log and not capsys.readouterr().err


def test_rows_that_are_read_one_after_the_other_are_no_wrong_mount():
    """As if all were read at once, this shutter's pictures lie some percent apart."""
    log = drive(readout_us=150_000)
    wrong = replace(log, cameras={"front": replace(log.camera("front"), shutter="global", readout_us=0)})
    assert mounts_by_road(log, ["front"], log.sweeps, ALL) is log
    assert mounts_by_road(wrong, ["front"], wrong.sweeps, ALL) is not wrong


def test_what_stands_before_the_road_is_not_taken_for_it():
    log = drive(HEIGHT - 0.08, wall=True)
    assert mounts_by_road(log, ["front"], log.sweeps, ALL) is log


def test_where_nothing_tells_nothing_is_done():
    log = drive(HEIGHT - 0.08)
    assert mounts_by_road(log, ["front"], (), ALL) is log, "no ground"
    assert mounts_by_road(log, ["front"], log.sweeps, (0, 400_000)) is log, "too few pictures"
    parked = replace(log.camera("front"), world_from_cam=log.camera("front").world_from_cam[:1].expand(COUNT, 4, 4))
    assert mounts_by_road(replace(log, cameras={"front": parked}), ["front"], log.sweeps, ALL).meta == {}, "it stands"
    behind = replace(log, sweeps=tuple(replace(s, time_us=s.time_us + 10_000_000) for s in log.sweeps))
    assert mounts_by_road(behind, ["front"], behind.sweeps, ALL) is behind, "no sweep was taken then"
