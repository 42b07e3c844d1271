import json
from dataclasses import replace

import pytest
import torch

from recon import open_log, reconstruct
from recon.sound import check_path, sound
from scenes.poses import translation, yaw


@pytest.fixture(scope="module")
def log(drive):
    return open_log(drive)


def with_front(log, **changes):
    front = log.camera("front_camera")
    return replace(log, cameras={**log.cameras, "front_camera": replace(front, **changes)})


def test_a_log_that_is_sound_stays_as_it_is(log, capsys):
    assert sound(log) == log and not capsys.readouterr().err


@pytest.mark.parametrize("off", [translation(0, 70, 0), yaw(0.6)])
def test_a_picture_whose_pose_is_astray_is_left_out(log, capsys, off):
    front = log.camera("front_camera")
    poses = front.world_from_cam.clone()
    poses[3] = poses[3] @ off
    found = sound(with_front(log, world_from_cam=poses))
    kept = found.camera("front_camera")
    assert len(kept) == len(front) - 1 and kept.files == (*front.files[:3], *front.files[4:])
    assert torch.equal(kept.world_from_cam, torch.cat([front.world_from_cam[:3], front.world_from_cam[4:]]))
    mounts = (x.rig({"front_camera": (96, 54)})["front_camera"].body_from_cam for x in (found, log))
    assert torch.allclose(*mounts, rtol=0, atol=0.01)
    said = capsys.readouterr().err
    assert "1 of 8 pictures of front_camera are left out, the first of them" in said and "03.jpg" in said
    assert set(found.cameras) == set(log.cameras)


def test_cameras_that_wander_on_the_body_are_left_whole(log, capsys):
    """Poses from another source than the body's path are apart from it, some more than others."""
    front = log.camera("front_camera")
    wander = translation(0, 0, 0).repeat(len(front), 1, 1)
    wander[:, 0, 3] = torch.linspace(0, 8, len(front), dtype=torch.float64)
    assert len(sound(with_front(log, world_from_cam=front.world_from_cam @ wander)).camera("front_camera")) == len(front)
    assert not capsys.readouterr().err


def test_pictures_that_outlast_the_path_are_left_out(log, capsys):
    front = log.camera("front_camera")
    last = int(log.ego.times_us[-3])
    short = replace(log, ego=replace(log.ego, times_us=log.ego.times_us[:-2], world_from_body=log.ego.world_from_body[:-2]))
    found = sound(short)
    assert 0 < len(found.camera("front_camera")) < len(front) and int(found.camera("front_camera").times_us[-1]) < last + 100_000
    assert "the body's path does not last as long" in capsys.readouterr().err
    with pytest.raises(ValueError, match="no camera took a picture while the body's path is known; check the clocks"):
        sound(replace(log, ego=replace(log.ego, times_us=log.ego.times_us + 10**9)))


def test_a_path_that_leaps_is_refused_before_the_fit(own_drive, tmp_path):
    path = own_drive / "lidar/poses.json"
    poses = json.loads(path.read_text())
    poses[5]["position"]["x"] += 5000.0
    path.write_text(json.dumps(poses))
    with pytest.raises(
        ValueError, match="the body's path leaps by 5000 m .* into the drive; correct that pose, or leave it out with --start"
    ):
        reconstruct(open_log(own_drive), tmp_path / "scene")
    assert not (tmp_path / "scene.fit").exists()


def test_a_span_before_the_leap_is_sound(log):
    poses = log.ego.world_from_body.clone()
    poses[6, 0, 3] += 5000.0
    leaping = replace(log, ego=replace(log.ego, world_from_body=poses))
    times = log.ego.times_us.tolist()
    check_path(leaping, (times[0], times[4]))
    with pytest.raises(ValueError, match="leaps by"):
        check_path(leaping, (times[0], times[7]))


def test_fast_and_sparse_paths_do_not_leap(log):
    """Pictures from a train, and photos half a second apart by name that were taken 60 m apart."""
    times = torch.arange(20) * 500_000
    poses = translation(0, 0, 0).repeat(20, 1, 1)
    poses[:, 0, 3] = torch.arange(20, dtype=torch.float64) * 60
    check_path(replace(log, ego=replace(log.ego, times_us=times, world_from_body=poses)), (0, 10**8))


def test_a_held_out_sweep_that_is_damaged_is_told_before_the_fit(own_drive, tmp_path):
    file = own_drive / "lidar" / "04.pkl.gz"
    file.write_bytes(file.read_bytes()[:-20])
    with pytest.raises(ValueError, match="04.pkl.gz is cut off or corrupt"):
        reconstruct(open_log(own_drive), tmp_path / "scene")
    assert not (tmp_path / "scene.fit").exists()


def test_photos_of_two_places_do_not_leap(log):
    poses = log.ego.world_from_body.clone()
    poses[5:, 0, 3] += 150.0
    two = replace(log, ego=replace(log.ego, world_from_body=poses))
    span = (int(log.ego.times_us[0]), int(log.ego.times_us[-1]))
    check_path(replace(two, meta={**log.meta, "world_from_model": {}}), span)
    with pytest.raises(ValueError, match="leaps by"):
        check_path(two, span)
