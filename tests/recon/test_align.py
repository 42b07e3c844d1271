"""Sweeps that recorded poses put apart are laid on one another, and with them all that the log knows of the world."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from recon.log import LidarPoints, Log, LogCamera, Sweep, Track
from recon.registration.align import _solved, about, aligned
from recon.registration.corrected import MOVED, REMOUNTED, TURNED, as_corrected, moved
from scenes.lenses import Pinhole
from scenes.poses import CAM_FROM_FLU, inverse, small_poses, translation, yaw
from scenes.trajectory import Trajectory

COUNT, STEP_US = 36, 100_000
UP = small_poses(torch.tensor([0, -0.3, 0, 0, 0, 0]))
"""Turns a body's nose up."""


def street(centre: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """World points of a road, houses whose fronts step back and forth, and poles, within 40 m of a place on the road; 1 cm of noise."""
    along = centre[0] + generator.uniform(-40, 40, 6000)
    road = np.stack([along, generator.uniform(-8, 8, 6000), np.zeros(6000)], 1)
    side = np.where(generator.random(6000) < 0.5, -1.0, 1.0)
    fronts = np.stack([along, side * (9 + 2 * (np.floor(along / 7) % 2)), generator.uniform(0, 6, 6000)], 1)
    corners = np.stack([7 * np.round(along / 7), side * generator.uniform(9, 11, 6000), generator.uniform(0, 6, 6000)], 1)
    return np.concatenate([road, fronts, corners]) + generator.normal(0, 0.01, (18_000, 3))


def drifting(height: float, metres: float = 0.0, radians: float = 0.0, shake: float = 0.0) -> tuple[Log, torch.Tensor]:
    """A log along the street whose recorded poses drift away, and by which poses `[T, 4, 4]` its world must be moved back at its stamps.
    shake: metres, and sixteenths in radians, that each is off by itself."""
    generator = np.random.default_rng(5)
    times = torch.arange(COUNT) * STEP_US
    truth = torch.eye(4, dtype=torch.float64).repeat(COUNT, 1, 1)
    truth[:, 0, 3] = 0.8 * torch.arange(COUNT)
    truth[:, 2, 3] = 1.7
    slow = torch.sin(torch.linspace(0, 3, COUNT, dtype=torch.float64))
    deltas = torch.zeros(COUNT, 6, dtype=torch.float64)
    deltas[:, 2], deltas[:, 4], deltas[:, 5] = radians * slow, metres * slow.flip(0), height * slow
    deltas += shake * torch.from_numpy(np.random.default_rng(6).normal(0, 1, (COUNT, 6))) / torch.tensor([16.0] * 3 + [1.0] * 3)
    drift = about(truth[:, :3, 3].numpy(), deltas.numpy())
    sweeps = []
    for i in range(COUNT):
        xyz = street(truth[i, :3, 3].numpy(), generator) @ drift[i, :3, :3].numpy().T + drift[i, :3, 3].numpy()
        points = LidarPoints(xyz, np.full(len(xyz), int(times[i])), np.zeros(len(xyz), np.int64))
        sweeps.append(Sweep(i, int(times[i]), lambda points=points: points))
    recorded = drift @ truth
    camera = LogCamera("front", Pinhole(50.0, 50.0, 32.0, 24.0), 64, 48, tuple(Path(str(i)) for i in range(COUNT)), times, recorded)
    box = drift @ torch.tensor([[1.0, 0, 0, 12], [0, 1, 0, 3], [0, 0, 1, 0], [0, 0, 0, 1]], dtype=torch.float64)
    track = Track("veh_1", "car", False, np.array([4.0, 2, 1.5]), times.numpy(), box, np.zeros(COUNT, np.int64), ("a",))
    return Log("made", Path("made"), {"front": camera}, tuple(sweeps), (track,), Trajectory(times, recorded), {}), inverse(drift)


def apart(poses: torch.Tensor) -> float:
    """Metres by which poses that should be one differ, at the origin of each."""
    return float((poses[:, :3, 3] - poses[:, :3, 3].mean(0)).norm(dim=1).max())


def test_a_path_that_drifts_is_bent_back(capsys):
    log, _ = drifting(height=0.4, metres=0.2, radians=0.01)
    assert apart(log.tracks[0].world_from_box) > 0.2
    better = aligned(log, log.sweeps)
    assert "lie up to 0." in capsys.readouterr().err
    assert apart(better.tracks[0].world_from_box) < 0.03, "the annotated box, which stands, stands"
    heights = [float(np.median(s.read().xyz[:6000, 2])) for s in better.sweeps]
    assert np.ptp(heights) < 0.015, "one road"
    body, seen = better.ego.world_from_body, better.camera("front").world_from_cam
    torch.testing.assert_close(body, seen, atol=1e-9, rtol=0)
    for k in (1, 30):
        way = (inverse(body[:-k]) @ body[k:])[:, :3, 3]
        assert float((way - torch.tensor([0.8 * k, 0, 0], dtype=torch.float64)).abs().max()) < 0.03


@pytest.mark.parametrize("shake", [0.02, 0.05])
def test_poses_that_are_each_off_by_themselves_are_put_right(shake):
    """By 5 cm and 3 mrad, say, where a drift between two is a centimetre at most."""
    log, _ = drifting(height=0.0, shake=shake)
    body = aligned(log, log.sweeps).ego.world_from_body
    assert apart(log.tracks[0].world_from_box) > 2 * shake
    for k in (1, 9):
        way = inverse(body[:-k]) @ body[k:]
        off = (way[:, :3, 3] - torch.tensor([0.8 * k, 0, 0], dtype=torch.float64)).abs().max()
        assert float(off) < 0.005, "the car goes evenly"
        assert float((way[:, :3, :3] - torch.eye(3)).abs().max()) < 1.5e-3


@pytest.mark.parametrize("step", [1, 4])
def test_corrections_of_sweeps_farther_apart_may_differ_more(step):
    """Where the second of two is drawn 1 m along x, as surely as sweeps differ by 1 cm."""
    drawn, towards = np.zeros((12, 12)), np.zeros(12)
    drawn[9, 9] = towards[9] = 1 / 0.01**2
    first, second = _solved(np.zeros((2, 6)), [(0, 1)], [(drawn, towards)], step)[:, 3]
    whole, steady, drawn = 1 / 2.0**2, 1 / (step * 0.01**2), 1 / 0.01**2
    assert (whole + steady) * first == pytest.approx(steady * second)
    assert (whole + steady + drawn) * second == pytest.approx(steady * first + drawn)


def test_a_drive_whose_sweeps_meet_is_left_alone(capsys):
    log, _ = drifting(height=0.01)
    assert aligned(log, log.sweeps) is log and not capsys.readouterr().err
    for few in (3, 9, 27, 28, 29):
        assert aligned(log, log.sweeps[:few]) is log, "too few to tell, or nothing to do"
    bare = replace(log, sweeps=tuple(replace(s, read=lambda: LidarPoints(np.zeros((0, 3)), np.zeros(0), np.zeros(0))) for s in log.sweeps))
    assert aligned(bare, bare.sweeps) is bare


def test_heights_that_are_not_recorded_are_found_however_small_they_are(capsys):
    log, _ = drifting(height=0.02)
    assert aligned(log, log.sweeps) is log
    better = aligned(replace(log, meta={"heights": False}), log.sweeps)
    assert apart(log.tracks[0].world_from_box) > 0.01 and "which are corrected" in capsys.readouterr().err
    assert apart(better.tracks[0].world_from_box) < 0.004


def test_sweeps_that_are_left_out_go_along(drift=0.4):
    """Those against which a scene is measured take no part, and are moved as their neighbours are."""
    log, back = drifting(height=drift)
    better = aligned(log, [s for s in log.sweeps if s.index % 8 != 4])
    left = [float(np.median(better.sweeps[i].read().xyz[:6000, 2])) for i in range(4, COUNT, 8)]
    assert np.ptp(left) < 0.02


def test_a_correction_takes_everything_with_it():
    log, back = drifting(height=0.4, radians=0.01)
    nothing = replace(log.tracks[0], times_us=np.zeros(0, np.int64), world_from_box=torch.zeros(0, 4, 4, dtype=torch.float64))
    better = moved(replace(log, tracks=(*log.tracks, nothing)), Trajectory(log.ego.times_us, back))
    truth = back @ log.ego.world_from_body
    torch.testing.assert_close(better.ego.world_from_body, truth)
    torch.testing.assert_close(better.camera("front").world_from_cam, truth)
    assert apart(better.tracks[0].world_from_box) == pytest.approx(0, abs=1e-9)
    assert np.ptp([np.median(s.read().xyz[:6000, 2]) for s in better.sweeps]) < 0.01


def test_a_recording_is_moved_again_as_its_scene_says():
    log, _ = drifting(height=0.4)
    better = aligned(log, log.sweeps)
    again = as_corrected(log, json.loads(json.dumps(better.meta)))
    torch.testing.assert_close(again.ego.world_from_body, better.ego.world_from_body, atol=1e-12, rtol=0)
    np.testing.assert_allclose(again.sweeps[7].read().xyz, better.sweeps[7].read().xyz, atol=1e-9)
    assert as_corrected(log, {}) is log


def test_all_that_was_corrected_is_so_again_in_the_order_in_which_it_was_found():
    """The path, how cameras are turned, how high they stand: each was measured where the former had put them."""
    log, back = drifting(height=0.4, radians=0.3)
    found = {
        MOVED: {"times_us": log.ego.times_us.tolist(), "poses": back.flatten(1).tolist()},
        TURNED: {"front": [0.3, -0.2, 0.1, 0.05, 0.1, -0.1, 0.03]},
        REMOUNTED: {"front": [0.2, 0.1]},
    }
    one_by_one = log
    for kind, what in found.items():
        one_by_one = as_corrected(one_by_one, {kind: what})
    at_once = as_corrected(log, json.loads(json.dumps(one_by_one.meta)))
    assert torch.equal(at_once.camera("front").times_us, one_by_one.camera("front").times_us)
    for one, other in ((at_once.ego, one_by_one.ego), (at_once.tracks[0].trajectory(), one_by_one.tracks[0].trajectory())):
        assert torch.equal(one.world_from_body, other.world_from_body)
    assert torch.equal(at_once.camera("front").world_from_cam, one_by_one.camera("front").world_from_cam)


def on_a_slope() -> Log:
    """A car that goes along y at 10 m/s, nose up by 0.3 rad; its camera is 1 m before its middle, 1.5 m up, and looks ahead."""
    log, times = drifting(height=0.0)[0], torch.tensor([0, 100_000])
    body = torch.stack([translation(4.0, 10 * t / 1e6, 2.0) for t in times.tolist()]) @ yaw(np.pi / 2) @ UP
    camera = replace(log.camera("front"), times_us=times, world_from_cam=body @ translation(1.0, 0.0, 1.5) @ inverse(CAM_FROM_FLU))
    return replace(log, cameras={"front": camera}, ego=Trajectory(torch.tensor([-100_000, 0, 100_000, 200_000]), torch.cat([
        translation(0.0, -1.0, 0.0)[None] @ body[:1], body, translation(0.0, 1.0, 0.0)[None] @ body[1:]])))  # fmt: skip


@pytest.mark.parametrize(
    ("motion", "place", "turned"), [([0, 0, 0, 0.1, 0.2, 0.3], (1.3, -0.1, 1.3), 0), ([0, 0.4, 0] + [0] * 3, (1, 0, 1.5), 0.4)]
)
def test_a_camera_that_was_late_and_is_fixed_otherwise_moves_along_and_on_its_mount(motion, place, turned):
    """50 ms later it is 0.5 m farther on; it stands 0.1 m farther right, 0.2 m down and 0.3 m ahead, or looks 0.4 rad farther right."""
    log = on_a_slope()
    camera = as_corrected(log, {TURNED: {"front": [*motion, 0.05], "gone": [0.0] * 7}}).camera("front")
    assert camera.times_us.tolist() == [50_000, 150_000]
    for k, y in enumerate((0.5, 1.5)):
        at = inverse(translation(4.0, y, 2.0) @ yaw(np.pi / 2) @ UP) @ camera.world_from_cam[k]
        assert at[:3, 3].tolist() == pytest.approx(place)
        assert at[:3, 2].tolist() == pytest.approx([np.cos(turned), -np.sin(turned), 0])


def test_a_camera_that_is_remounted_goes_up_on_its_car_and_looks_farther_up():
    log = on_a_slope()
    camera = as_corrected(log, {REMOUNTED: {"front": [0.2, 0.1], "gone": [1.0, 1.0]}}).camera("front")
    at = inverse(log.ego.near_each(camera.times_us)) @ camera.world_from_cam
    for pose in at:
        assert pose[:3, 3].tolist() == pytest.approx([1.0, 0, 1.7])
        assert pose[:3, 2].tolist() == pytest.approx([np.cos(0.1), 0, np.sin(0.1)])


def test_lidars_that_turn_together_are_laid_on_others_together():
    log, _ = drifting(height=0.4)
    halves = []
    for sweep in log.sweeps:
        points = sweep.read()
        for k in (0, 1):
            half = LidarPoints(points.xyz[k::2], points.times_us[k::2], points.sensor[k::2])
            halves.append(Sweep(2 * sweep.index + k, sweep.time_us, lambda half=half: half))
    two = aligned(replace(log, sweeps=tuple(halves)), halves)
    assert apart(two.tracks[0].world_from_box) < 0.03 and len(two.sweeps) == 2 * COUNT
