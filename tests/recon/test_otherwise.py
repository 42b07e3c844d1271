"""Drives as if something of them were otherwise (tests/bench/otherwise.py): what is not said to be otherwise stays."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from recon import open_log
from recon.log import Log
from recon.registration.corrected import moved
from scenes.lenses import FTheta, OpenCV, Pinhole
from scenes.poses import inverse, translation
from scenes.sky import linear_from_srgb
from scenes.trajectory import Trajectory
from tests.bench import changed_pictures, changed_records
from tests.bench.changes import CHANGES
from tests.bench.otherwise import measured_by

LENSES = [
    Pinhole(500.0, 490.0, 310.0, 250.0),
    OpenCV(500.0, 490.0, 310.0, 250.0, -0.2, 0.05, 0.01, -0.02, 0.01, s1=0.01, s2=-0.02, s3=0.03, s4=0.01),
    FTheta(310.0, 250.0, 480.0, -8.0, c=1.02, d=0.03, e=-0.02),
]


@pytest.fixture(scope="module")
def log(drive):
    return open_log(drive)


@pytest.mark.parametrize("name", CHANGES)
def test_each_says_what_it_is_and_keeps_cameras_and_pictures_readable(log, name):
    change = CHANGES[name]
    otherwise = change.make(log)
    assert change.what
    assert list(otherwise.cameras) == list(log.cameras)
    for camera in otherwise.cameras.values():
        assert len(camera.files) == len(camera.times_us) == len(camera.world_from_cam)
        assert camera.image(1).shape == (camera.height, camera.width, 3)
        assert np.array_equal(camera.image(1), camera.image(1)), "chance is the same each time a picture is read"
        assert otherwise.ego.covers_each(camera.times_us).all()
    for track in otherwise.tracks:
        assert len(track.times_us) == len(track.world_from_box) == len(track.sensor) > 0


def test_mirrored_twice_is_as_recorded(log):
    again = changed_records.mirrored(changed_records.mirrored(log))
    for name, camera in log.cameras.items():
        assert again.camera(name).lens == camera.lens
        torch.testing.assert_close(again.camera(name).world_from_cam, camera.world_from_cam)
        assert np.array_equal(again.camera(name).image(2), camera.image(2))
    assert np.array_equal(again.sweeps[0].read().xyz, log.sweeps[0].read().xyz)
    torch.testing.assert_close(again.tracks[0].world_from_box, log.tracks[0].world_from_box)
    torch.testing.assert_close(again.ego.world_from_body, log.ego.world_from_body)


@pytest.mark.parametrize("lens", LENSES, ids=lambda lens: lens.kind)
def test_a_point_is_as_far_from_the_other_border_in_a_mirror(log, lens):
    name, camera = next(iter(log.cameras.items()))
    log = replace(log, cameras={name: replace(camera, lens=lens, width=640, height=480)})
    mirrored = changed_records.mirrored(log).camera(name).camera(0)
    local = torch.tensor([[0.8, -0.3, 4.0, 1.0], [-1.5, 0.4, 6.0, 1.0]], dtype=torch.float64)
    world = local @ log.camera(name).world_from_cam[0].T
    there = (world * torch.tensor([1.0, -1, 1, 1])) @ inverse(mirrored.world_from_cam).T
    torch.testing.assert_close(there[:, 2], local[:, 2])
    seen, was = mirrored.lens.project(there[:, :3]), lens.project(local[:, :3])
    torch.testing.assert_close(seen, torch.stack([640 - was[:, 0], was[:, 1]], 1))
    assert float(torch.det(mirrored.world_from_cam[:3, :3])) == pytest.approx(1.0), "a mirrored pose turns, and does not mirror"


def test_elsewhere_all_lies_as_it_lay_about_the_car(log):
    there = changed_records.elsewhere(log)
    away = there.ego.world_from_body[0, :3, 3] - log.ego.world_from_body[0, :3, 3]
    assert float(away[:2].norm()) == pytest.approx(58_000, rel=0.01)
    assert float(away[2]) == pytest.approx(300)
    for name in log.cameras:
        torch.testing.assert_close(there.offsets(name), log.offsets(name), atol=1e-8, rtol=0)
    for before, after in zip(log.sweeps, there.sweeps, strict=True):
        assert np.allclose(_about_the_car(there, after), _about_the_car(log, before), atol=1e-8)


def test_at_half_the_rate_every_other_of_all_is_left(log):
    half = changed_records.half_rate(log)
    name, camera = next(iter(log.cameras.items()))
    assert half.camera(name).files == camera.files[::2]
    assert [s.time_us for s in half.sweeps] == [s.time_us for s in log.sweeps if s.index % 2 == 0]
    assert [s.index for s in half.sweeps] == [s.index // 2 for s in log.sweeps if s.index % 2 == 0]
    frames = log.ego.times_us[1:-1]
    for moment in frames[::2]:
        torch.testing.assert_close(half.ego.at(int(moment)), log.ego.at(int(moment)))
    assert {int(t) for track in half.tracks for t in track.times_us} <= set(frames[::2].tolist())
    assert sum(len(t.times_us) for t in half.tracks) < 0.7 * sum(len(t.times_us) for t in log.tracks)


@pytest.mark.parametrize("name", ["faster", "slower"])
def test_on_another_clock_all_is_where_it_was(log, name):
    begun, clock = int(log.camera("front_camera").times_us[0]), CHANGES[name].clock
    otherwise = CHANGES[name].make(log)
    kept = 3 if name == "faster" else 1
    camera, was = otherwise.camera("front_camera"), log.camera("front_camera").part(slice(None, None, kept))
    torch.testing.assert_close(camera.times_us - begun, ((was.times_us - begun) * clock).round().long(), atol=1, rtol=0)
    torch.testing.assert_close(camera.world_from_cam, was.world_from_cam)
    assert camera.readout_us == round(was.readout_us * clock)
    first, before = otherwise.sweeps[0], log.sweeps[0]
    assert np.allclose((first.read().times_us - begun) / clock, before.read().times_us - begun, atol=5)
    mover, again = (next(t for t in of.tracks if t.moving) for of in (log, otherwise))
    moment = int(mover.times_us[0])
    then = begun + round((moment - begun) * clock)
    torch.testing.assert_close(again.trajectory().at(then), mover.trajectory().at(moment), atol=1e-4, rtol=0)


def test_late_pictures_are_where_the_car_was_later(log):
    late = changed_records.late_pictures(log)
    name = "front_camera"
    assert (late.camera(name).times_us - log.camera(name).times_us == 30_000).all()
    torch.testing.assert_close(late.offsets(name)[:-1], log.offsets(name)[:-1], atol=1e-6, rtol=0)


def test_what_is_shaken_is_off_by_as_much_as_is_said():
    still = Trajectory(torch.arange(2000) * 100_000, translation(40.0, 5.0, 1.0).repeat(2000, 1, 1))
    log = _nothing_but(still)
    off = inverse(still.world_from_body) @ changed_records.shaken_path(log).ego.world_from_body
    assert off[:, :3, 3].std(0).tolist() == pytest.approx([0.05] * 3, rel=0.1)
    turns = torch.stack([off[:, 2, 1], off[:, 0, 2], off[:, 1, 0]])
    assert turns.std(1).tolist() == pytest.approx([0.003] * 3, rel=0.1)


def test_shaken_boxes_lie_about_those_recorded(log):
    mover = next(t for t in log.tracks if t.moving)
    shaken = changed_records.shaken_boxes(replace(log, tracks=tuple(replace(mover, sources=(str(i),)) for i in range(100)))).tracks
    sizes = np.array([t.size[0] / mover.size[0] for t in shaken])
    assert {round(float(s), 6) for s in sizes} == {0.95, 1.05}
    counts = {source: 0 for t in shaken for source in t.sources}
    off = []
    for track in shaken:
        kept = [i for i, t in enumerate(track.times_us) if t in mover.times_us]
        counts[track.sources[0]] += len(kept)
        off.append(inverse(mover.trajectory().at_each(torch.from_numpy(track.times_us[kept]))) @ track.world_from_box[kept])
    assert sum(counts.values()) == pytest.approx(70 * len(mover.times_us), rel=0.1)
    assert torch.cat(off)[:, :3, 3].std(0).tolist() == pytest.approx([0.15, 0.15, 0.0], abs=0.02)


def test_a_spoilt_drive_is_measured_by_what_was_recorded(log):
    boxes = changed_records.late_boxes(log)
    assert measured_by(log, boxes, boxes, "boxes").tracks == log.tracks
    raised = moved(log, Trajectory(torch.tensor([0]), translation(0.0, 0.0, 0.4)[None]))
    there = measured_by(log, changed_records.shaken_path(log), raised, "path")
    assert np.allclose(there.sweeps[0].read().xyz - log.sweeps[0].read().xyz, [0, 0, 0.4])


def test_pictures_are_as_they_are_said_to_be(log):
    def light(of, index=1):
        return linear_from_srgb(torch.from_numpy(of.camera("front_camera").image(index).copy()) / 255)

    recorded = light(log)
    assert float(light(changed_pictures.dark(log)).mean() / recorded.mean()) == pytest.approx(0.25, rel=0.03)
    dirt = light(changed_pictures.dirt(log)) / recorded.clamp_min(0.01)
    height, width = dirt.shape[:2]
    middles = [float(dirt[int(down * height), int(across * width)].mean()) for across, down in changed_pictures.SPOTS]
    assert max(middles) < 0.45 and float(dirt.median()) == pytest.approx(1.0, abs=0.02)
    walk = [changed_pictures.darker(i) for i in range(200)]
    assert set(walk) == {0, 1, 2, 3} and set(np.abs(np.diff(walk))) == {1}
    exposed = changed_pictures.exposure(log)
    for index in range(4):
        expected = changed_pictures.STOP ** -changed_pictures.darker(index)
        assert float(light(exposed, index).mean() / light(log, index).mean()) == pytest.approx(expected, rel=0.02)


def _about_the_car(log, sweep) -> np.ndarray:
    back = inverse(log.ego.near(sweep.time_us)).numpy()
    return sweep.read().xyz @ back[:3, :3].T + back[:3, 3]


def _nothing_but(ego: Trajectory) -> Log:
    return Log("nothing", Path("nothing"), {}, (), (), ego, {})
