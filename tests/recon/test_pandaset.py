import json
import shutil

import numpy as np
import pandas as pd
import pytest
import torch
from made_drive import ABSENT, SCANNED_US

from recon import open_log
from recon.objects.actors import inside
from recon.objects.tracks import slug
from recon.readers.pandaset import LABELS
from scenes.poses import inverse


def test_the_made_drive_reads_as_it_was_written(drive, street):
    log = open_log(drive)
    assert list(log.cameras) == ["front_camera", "left_camera"]
    assert [s.index for s in log.sweeps] == [i for i in range(8) if i != ABSENT]
    for name, camera in log.cameras.items():
        assert camera.times_us.tolist() == street.frame_times(name).tolist() and camera.lens == street.rig[name].lens
        expected = torch.stack([street.camera(name, t).world_from_cam for t in camera.times_us.tolist()])
        torch.testing.assert_close(camera.world_from_cam, expected, atol=1e-9, rtol=0)
    assert log.meta["licence"] == "CC BY 4.0" and "Hesai" in log.meta["attribution"]


def test_the_body_is_the_lidar_pose_turned_to_forward_left_up(drive, street):
    log = open_log(drive)
    for t in street.ego.times_us[:8].tolist():
        torch.testing.assert_close(log.ego.at(t), street.ego.at(t), atol=1e-9, rtol=0)


def test_the_body_covers_cameras_that_fire_before_its_first_stamp(drive):
    log = open_log(drive)
    assert log.ego.covers(int(log.cameras["front_camera"].times_us[0]) - 81_000)


def test_the_rig_of_a_rigid_drive_reproduces_its_camera_poses(drive, street):
    log = open_log(drive)
    for name, camera in log.rig(dict.fromkeys(log.cameras, (96, 54))).items():
        torch.testing.assert_close(camera.body_from_cam, street.rig[name].body_from_cam, atol=1e-6, rtol=0)
        assert log.offsets(name).std(0).max() < 1e-6


def test_sibling_cuboids_become_one_track_with_its_heading(drive, street):
    log = open_log(drive)
    assert len(log.tracks) == 2
    mover = next(t for t in log.tracks if t.moving)
    assert mover.sources == ("mover-a", "mover-b") and mover.label == "car" and mover.name.startswith("veh_")
    np.testing.assert_allclose(mover.size, street.actors[0].asset.size.numpy(), atol=1e-9)
    for t, pose in zip(mover.times_us.tolist()[1:], mover.world_from_box[1:], strict=True):
        torch.testing.assert_close(pose, street.actors[0].trajectory.at(t + SCANNED_US), atol=1e-6, rtol=0)


def test_images_are_area_averaged_to_the_working_size(drive):
    camera = open_log(drive).camera("front_camera")
    full, half = camera.image(2), camera.image(2, 48, 27)
    mean = full.reshape(27, 2, 48, 2, 3).astype(float).mean((1, 3))
    assert np.abs(half - mean).max() <= 1


def test_a_camera_that_does_not_exist_is_named_with_the_nearest(drive):
    with pytest.raises(ValueError, match="Did you mean front_camera"):
        open_log(drive).camera("frnt_camera")


def test_a_missing_image_is_named(own_drive):
    (own_drive / "camera/left_camera/05.jpg").unlink()
    with pytest.raises(FileNotFoundError, match="left_camera/05.jpg is missing"):
        open_log(own_drive)


def test_a_piece_of_a_drive_is_read_as_far_as_its_pictures_go(drive, own_drive, capsys):
    for i in (5, 6, 7):
        (own_drive / f"camera/left_camera/{i:02d}.jpg").unlink()
    whole, piece = open_log(drive).camera("left_camera"), open_log(own_drive).camera("left_camera")
    assert capsys.readouterr().err == f"{own_drive}/camera/left_camera holds the first 5 of 8 pictures, which are read\n"
    assert [f.name for f in piece.files] == [f.name for f in whole.files[:5]]
    assert torch.equal(piece.times_us, whole.times_us[:5]) and torch.equal(piece.world_from_cam, whole.world_from_cam[:5])
    for file in (own_drive / "camera/left_camera").glob("*.jpg"):
        file.unlink()
    with pytest.raises(FileNotFoundError, match="left_camera/00.jpg is missing"):
        open_log(own_drive)


def test_an_image_that_does_not_decode_is_named(own_drive):
    file = own_drive / "camera/front_camera/02.jpg"
    file.write_bytes(file.read_bytes()[:400])
    with pytest.raises(ValueError, match="front_camera/02.jpg does not decode"):
        open_log(own_drive).camera("front_camera").image(2)


@pytest.mark.parametrize("file", ["poses.json", "timestamps.json", "intrinsics.json"])
def test_corrupt_and_missing_json_is_named(own_drive, file):
    path = own_drive / "camera/front_camera" / file
    path.write_text(path.read_text()[:-5])
    with pytest.raises(ValueError, match=file):
        open_log(own_drive)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=file):
        open_log(own_drive)


def test_json_of_another_shape_is_refused(own_drive):
    path = own_drive / "camera/front_camera/poses.json"
    path.write_text(json.dumps([{"position": {"x": 0}}] * 8))
    with pytest.raises(ValueError, match="poses.json"):
        open_log(own_drive)


def test_times_that_do_not_rise_are_refused(own_drive):
    path = own_drive / "lidar/timestamps.json"
    times = json.loads(path.read_text())
    path.write_text(json.dumps(times[:4] + times[3:7]))
    with pytest.raises(ValueError, match="rise strictly at entry 4"):
        open_log(own_drive)


def test_a_sweep_without_its_columns_is_named_when_read(own_drive):
    shutil.copy(own_drive / "annotations/cuboids/00.pkl.gz", own_drive / "lidar/00.pkl.gz")
    log = open_log(own_drive)
    with pytest.raises(ValueError, match="00.pkl.gz has no column 'x'"):
        log.sweeps[0].read()


def test_a_sweep_of_another_clock_is_named_when_read(own_drive):
    file = own_drive / "lidar" / "00.pkl.gz"
    table = pd.read_pickle(file)
    table.assign(t=table.t - 37.0).to_pickle(file)  # GPS time has no leap seconds, or too many
    with pytest.raises(ValueError, match=r"00.pkl.gz: its points were taken 37 s before its stamp in timestamps.json"):
        open_log(own_drive).sweeps[0].read()


def test_points_without_a_place_or_a_time_are_left_out(own_drive):
    file = own_drive / "lidar" / "00.pkl.gz"
    all_there = open_log(own_drive).sweeps[0].read()
    table = pd.read_pickle(file)
    table.loc[0, "x"], table.loc[1, "t"] = np.nan, np.nan
    table.to_pickle(file)
    points = open_log(own_drive).sweeps[0].read()
    assert len(points.xyz) == len(all_there.xyz) - 2 and (points.times_us > 0).all()


def test_a_drive_without_boxes_or_gps_is_a_drive(own_drive):
    shutil.rmtree(own_drive / "annotations")
    shutil.rmtree(own_drive / "meta")
    assert open_log(own_drive).tracks == ()


def test_a_drive_that_lacks_boxes_of_some_sweeps_says_so_and_what_moves_is_there_no_longer(own_drive, capsys):
    for i in (0, 1, 3, 4, 5, 6, 7):
        (own_drive / f"annotations/cuboids/{i:02d}.pkl.gz").unlink()
    log = open_log(own_drive)
    assert "annotations/cuboids has the boxes of 1 of 8 sweeps, and not 00.pkl.gz: fetch all" in capsys.readouterr().err
    mover = next(t for t in log.tracks if t.moving)
    stamps = [s.time_us for s in log.sweeps]
    assert [mover.trajectory().covers(t) for t in stamps] == [s.index == 2 for s in log.sweeps]


def test_a_folder_that_is_no_drive_is_refused_with_the_drive_inside(own_drive, tmp_path):
    with pytest.raises(ValueError, match=str(own_drive)):
        open_log(tmp_path)
    with pytest.raises(FileNotFoundError):
        open_log(tmp_path / "nowhere")


def test_labels_become_slugs():
    assert [slug(x, LABELS) for x in ("Car", "Pickup Truck", "Medium-sized Truck", "Pedestrian with Object", "Rolling Containers", "")] == [
        "car", "pickup", "truck", "pedestrian", "rolling-containers", "object",
    ]  # fmt: skip


def test_drive_002_has_what_its_page_says(pandaset):
    log = open_log(pandaset)
    assert len(log.cameras) == 5 and all(len(c) == 80 for c in log.cameras.values())
    assert (log.cameras["front_camera"].width, log.cameras["left_camera"].width) == (1920, 960)
    assert len(log.sweeps) == 76 and not {56, 57, 58, 71} & {s.index for s in log.sweeps}
    moving = [t for t in log.tracks if t.moving]
    assert 34 <= len(moving) <= 38 and sum(len(t.sources) for t in moving) == 67
    travelled = (log.ego.world_from_body[-2, :3, 3] - log.ego.world_from_body[1, :3, 3]).norm()
    assert 20 < float(travelled) < 22.5


def test_the_lidar_of_drive_002_falls_into_the_moving_boxes(pandaset):
    log = open_log(pandaset)
    sweep = next(s for s in log.sweeps if s.index == 40)
    points = sweep.read().xyz
    counts = []
    for track in log.tracks:
        if track.moving and sweep.time_us in track.times_us:
            pose = track.world_from_box[list(track.times_us).index(sweep.time_us)]
            local = points @ inverse(pose).numpy()[:3, :3].T + inverse(pose).numpy()[:3, 3]
            counts.append(inside(local, track.size, 0.1).sum())
    assert max(counts) > 3000 and np.median(counts) >= 20


def test_stamps_of_another_unit_and_lenses_without_numbers_are_named(own_drive):
    path = own_drive / "lidar/timestamps.json"
    times = path.read_text()
    path.write_text(json.dumps([t * 1e6 for t in json.loads(times)]))
    with pytest.raises(ValueError, match="lidar/timestamps.json must give seconds"):
        open_log(own_drive)
    path.write_text(times)
    (own_drive / "camera/front_camera/intrinsics.json").write_text('{"fx": NaN, "fy": 9, "cx": 1, "cy": 1}')
    with pytest.raises(ValueError, match="front_camera/intrinsics.json must give numbers fx, fy, cx, cy: fx must be a positive"):
        open_log(own_drive)


def test_a_place_is_known_from_where_gps_has_one(own_drive):
    path = own_drive / "meta/gps.json"
    rows = json.loads(path.read_text())
    nothing = dict.fromkeys(("lat", "long", "height"), float("nan"))
    path.write_text(json.dumps([nothing, *rows[1:]]))
    assert open_log(own_drive).meta["geodetic_origin"]["lat"] == rows[1]["lat"]
    path.write_text(json.dumps([nothing] * len(rows)))
    assert "geodetic_origin" not in open_log(own_drive).meta


def test_its_lidar_stands_where_its_beams_meet(pandaset):
    """From there a beam's points lie at one elevation, from elsewhere they do not: the car stands in the first sweeps."""
    log = open_log(pandaset)
    found = [sweep.read() for sweep in log.sweeps[:8]]
    back = inverse(log.ego.at(log.sweeps[0].time_us)).numpy()
    local = np.concatenate([p.xyz[p.sensor == 0] for p in found]) @ back[:3, :3].T + back[:3, 3]
    local = local[np.abs(np.linalg.norm(local, axis=1) - 25) < 20]

    def sharp(place) -> float:
        from_there = local - place
        elevations = np.degrees(np.arctan2(from_there[:, 2], np.linalg.norm(from_there[:, :2], axis=1)))
        counts = np.histogram(elevations, np.arange(-26, 16, 0.05))[0].astype(float)
        return float(np.square(counts).sum() / counts.sum() ** 2)

    there = sharp(log.lidars[0])
    for off in ([0, 0, -1.77], [0, 0, 0.3], [0, 0, -0.3], [0.6, 0, 0], [-0.6, 0, 0], [0, 0.4, 0], [0, -0.4, 0]):
        assert there > 1.005 * sharp(log.lidars[0] + off), off
