import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from made_kitti import write_kitti_odometry, write_kitti_raw
from made_tape import STAMPS, check, tape
from PIL import Image

from recon import open_log


@pytest.fixture(scope="module")
def recorded(street):
    return tape(street)


@pytest.fixture(scope="module")
def raw(recorded, tmp_path_factory):
    return write_kitti_raw(tmp_path_factory.mktemp("raw"), recorded)


@pytest.fixture(scope="module")
def odometry(recorded, tmp_path_factory):
    return write_kitti_odometry(tmp_path_factory.mktemp("odometry"), recorded)


@pytest.fixture
def own(raw, tmp_path):
    return shutil.copytree(raw.parent, tmp_path / raw.parent.name) / raw.name


@pytest.fixture
def own_sequence(odometry, tmp_path):
    shutil.copytree(odometry.parents[1], tmp_path / "dataset")
    return tmp_path / "dataset/sequences/04"


def test_a_raw_drive_reads_as_it_was_recorded(raw, recorded):
    log = open_log(raw)
    check(log, recorded, {"front": "image_02", "right": "image_03"}, atol=1e-5)
    assert log.front == ("image_02",) and len(log.tracks) == 2 and log.sweeps[0].time_us == STAMPS[0]
    assert log.meta["geodetic_origin"]["lat"] == pytest.approx(49.0) and "CC BY-NC-SA" in log.meta["licence"]


def test_a_sequence_reads_as_it_was_recorded(odometry, recorded):
    """Its clock starts at 0, and it has no boxes."""
    log = open_log(odometry)
    late = replace(recorded, ego=replace(recorded.ego, times_us=recorded.ego.times_us - int(STAMPS[0])))
    actor = recorded.street.actors[0]
    early = replace(actor, trajectory=replace(actor.trajectory, times_us=actor.trajectory.times_us - int(STAMPS[0])))
    late = replace(late, street=replace(recorded.street, actors=(early,), ego=late.ego))
    lead = log.camera("image_2")
    assert log.lidars[0].dtype == float  # 64 bits, as all places are
    assert lead.times_us.tolist() == [100_000 * i for i in range(6)] and log.tracks == () and len(log.sweeps) == 5
    for name in ("image_2", "image_3"):
        assert torch.isfinite(log.camera(name).world_from_cam).all()
    for i, t in enumerate(lead.times_us.tolist()):
        a = torch.linalg.inv(lead.world_from_cam[0]) @ log.camera("image_3").world_from_cam[i]
        b = torch.linalg.inv(late.camera("front", 0).world_from_cam) @ late.camera("right", t).world_from_cam
        torch.testing.assert_close(a, b, atol=1e-6, rtol=0)
    sweep = log.sweeps[-1].read()
    away = torch.linalg.inv(late.camera("front", 0).world_from_cam).numpy()
    home = torch.linalg.inv(lead.world_from_cam[0]).numpy()
    ours = sweep.xyz @ home[:3, :3].T + home[:3, 3]
    assert abs(ours - (late.points @ away[:3, :3].T + away[:3, 3])).max() < 1e-3
    back = torch.linalg.inv(log.ego.at(500_000)).numpy()
    x, y = back[:2, :3] @ sweep.xyz.T + back[:2, 3:]
    np.testing.assert_allclose(sweep.times_us, 500_000 + np.arctan2(y, x) / (2 * np.pi) * 100_000, atol=2)  # untwisted, not taken at once


def test_a_car_that_rolls_and_pitches_stands_as_the_devkit_has_it(own):
    """R = Rz(yaw) Ry(pitch) Rx(roll), each counter-clockwise about its axis (convertOxtsToPose.m)."""
    roll, pitch, yaw = 0.1, -0.2, 0.3
    for file in (own / "oxts/data").iterdir():
        numbers = file.read_text().split()
        file.write_text(" ".join([*numbers[:3], str(roll), str(pitch), str(yaw), *numbers[6:]]))
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    about_x, about_y = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]]), np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    turns = open_log(own).ego.world_from_body[:, :3, :3].numpy()
    np.testing.assert_allclose(turns, np.broadcast_to(about_z @ about_y @ about_x, turns.shape), atol=1e-9)


def test_a_spinning_lidars_points_stand_still_though_the_car_moves(raw, recorded):
    """Taken as one moment, the same sweep would smear by what the car drives in half a turn."""
    log = open_log(raw)
    first, last = log.sweeps[0].read(), log.sweeps[-1].read()
    assert abs(first.xyz - last.xyz).max() < 0.02 and first.times_us.std() > 10_000


@pytest.mark.parametrize(
    "file", ["../calib_cam_to_cam.txt", "../calib_velo_to_cam.txt", "../calib_imu_to_velo.txt", "oxts/data/0000000003.txt",
             "image_02/timestamps.txt", "image_03/data/0000000004.png", "velodyne_points/timestamps.txt"],
)  # fmt: skip
def test_a_missing_file_of_a_raw_drive_is_named(own, file):
    (own / file).unlink()
    with pytest.raises(FileNotFoundError, match=f"{(own / file).name} is missing"):
        open_log(own)


def test_a_piece_of_a_raw_drive_is_read_as_far_as_its_pictures_go(raw, own, capsys):
    """As others share it: all time stamps, the first pictures and sweeps."""
    for i in (4, 5):
        (own / f"image_02/data/{i:010d}.png").unlink()
        (own / f"velodyne_points/data/{i:010d}.bin").unlink()
    whole, piece = open_log(raw), open_log(own)
    told = [line for line in capsys.readouterr().err.splitlines() if "pictures" in line]
    assert told == [f"{own}/image_02/data holds the first 4 of 6 pictures, which are read"]
    _first_of(whole.camera("image_02"), piece.camera("image_02"), 4)
    assert len(piece.camera("image_03")) == 6 and [s.index for s in piece.sweeps] == [0, 1, 3]
    assert torch.equal(piece.ego.times_us, whole.ego.times_us) and len(piece.tracks) == 2
    assert abs(piece.sweeps[-1].read().xyz - whole.sweeps[2].read().xyz).max() == 0


def test_a_piece_of_a_raw_drive_is_read_as_far_as_its_oxts_go(raw, own, capsys):
    """And one frame on, where constant motion leads."""
    for i in (3, 4, 5):
        (own / f"oxts/data/{i:010d}.txt").unlink()
    for i in (4, 5):
        (own / f"image_02/data/{i:010d}.png").unlink()
    whole, piece = open_log(raw), open_log(own)
    assert f"{own}/oxts/data holds the first 3 of 6 packets, which are read" in capsys.readouterr().err
    assert [len(camera) for camera in piece.cameras.values()] == [4, 4] and [s.index for s in piece.sweeps] == [0, 1, 3]
    torch.testing.assert_close(piece.camera("image_03").world_from_cam, whole.camera("image_03").world_from_cam[:4], atol=0.02, rtol=0)
    assert all(track.times_us[-1] <= piece.ego.times_us[-1] for track in piece.tracks) and len(piece.tracks) == 2


def test_a_drive_without_oxts_is_told_so(own):
    shutil.rmtree(own / "oxts")
    with pytest.raises(FileNotFoundError, match="oxts is missing; it says where a KITTI drive's car was: fetch it too"):
        open_log(own)


def test_pictures_that_were_made_smaller_are_read_too(own, own_sequence):
    for folder in (own / "image_02/data", own_sequence / "image_2"):
        for file in folder.glob("*.png"):
            with Image.open(file) as picture:
                picture.save(file.with_suffix(".jpg"))
            file.unlink()
    for path, name in ((own, "image_02"), (own_sequence, "image_2")):
        cameras = open_log(path).cameras
        assert len(cameras) == 2 and [f.suffix for f in cameras[name].files] == [".jpg"] * 6


def test_boxes_are_read_without_the_lidar_they_were_drawn_by(raw, own):
    shutil.rmtree(own / "velodyne_points")
    whole, bare = open_log(raw).tracks, open_log(own).tracks
    assert [t.name for t in bare] == [t.name for t in whole] == ["veh_1", "veh_2"]
    for a, b in zip(bare, whole, strict=True):
        assert np.array_equal(a.times_us, b.times_us) and torch.equal(a.world_from_box, b.world_from_box)


def test_pictures_whose_calibration_knows_no_lidar_are_read_from_the_camera(odometry, own_sequence):
    calib = own_sequence / "calib.txt"
    calib.write_text("".join(line for line in calib.read_text().splitlines(True) if not line.startswith("Tr")))
    with pytest.raises(ValueError, match=r"calib.txt must give 12 numbers as Tr"):
        open_log(own_sequence)
    shutil.rmtree(own_sequence / "velodyne")
    whole, blind = open_log(odometry), open_log(own_sequence)
    assert blind.meta["body"].startswith("first camera") and len(blind.sweeps) == 0
    for name in ("image_2", "image_3"):
        one, other = (log.camera(name).world_from_cam for log in (whole, blind))
        assert (torch.linalg.inv(one[0]) @ one - torch.linalg.inv(other[0]) @ other).abs().max() < 1e-9
        assert other[0, 2, 1] < -0.99  # the camera's y points down


def test_a_sequence_that_begins_on_a_slope_stands_upright(own_sequence, odometry):
    def nodding(row):  # the first camera looks up by a tenth
        pose = torch.tensor(row).reshape(3, 4).double()
        up = torch.tensor([[1, 0, 0], [0, np.cos(0.1), -np.sin(0.1)], [0, np.sin(0.1), np.cos(0.1)]])
        pose[:, :3] = pose[:, :3] @ up if nodded == [] else pose[:, :3]
        nodded.append(row)
        return " ".join(f"{v:.12e}" for v in pose.flatten().tolist())

    nodded = []
    rewritten(own_sequence.parents[1] / "poses/04.txt", lambda _, row: nodding(row))
    slope, level = (open_log(path).ego.world_from_body[1:-1] for path in (own_sequence, odometry))
    assert len(nodded) == len(slope) and slope[0, 2, 2] < 0.997
    assert (slope[1:, 2, 2] > 0.9997).all() and (level[:, 2, 2] > 0.9999).all()
    for first in (slope[0], level[0]):
        assert first[:3, 3].abs().max() < 1e-9 and abs(float(first[1, 0])) < 1e-9 and first[0, 0] > 0.99


def test_a_piece_of_a_sequence_is_read_as_far_as_its_pictures_go(odometry, own_sequence, capsys):
    for file in ("image_2/000005.png", "image_3/000005.png", "velodyne/000005.bin"):
        (own_sequence / file).unlink()
    whole, piece = open_log(odometry), open_log(own_sequence)
    assert capsys.readouterr().err.count("holds the first 5 of 6 pictures") == 2
    for name in ("image_2", "image_3"):
        _first_of(whole.camera(name), piece.camera(name), 5)
    assert piece.sweeps[-1].index == 4


def _first_of(whole, piece, count):
    assert len(piece) == len(piece.times_us) == len(piece.world_from_cam) == count
    assert [f.name for f in piece.files] == [f.name for f in whole.files[:count]]
    assert torch.equal(piece.times_us, whole.times_us[:count]) and torch.equal(piece.world_from_cam, whole.world_from_cam[:count])


@pytest.mark.parametrize("lost", ["0000000000.png", "0000000002.png"])
def test_a_picture_missing_before_others_is_a_broken_download(own, lost):
    (own / "image_03/data" / lost).unlink()
    (own / "image_03/data/0000000005.png").unlink()
    with pytest.raises(FileNotFoundError, match=f"image_03/data/{lost} is missing; the time stamps name 6 frames"):
        open_log(own)


def test_wrong_numbers_of_a_raw_drive_are_named(own):
    calib = own.parent / "calib_cam_to_cam.txt"
    text = calib.read_text()
    calib.write_text(text.replace("R_rect_00: ", "R_rect_00: 1 "))
    with pytest.raises(ValueError, match="calib_cam_to_cam.txt must give 9 numbers as R_rect_00, got 10"):
        open_log(own)
    calib.write_text(text)
    (own / "oxts/timestamps.txt").write_text("yesterday\n")
    with pytest.raises(ValueError, match="timestamps.txt, line 1: 'yesterday' is not a time"):
        open_log(own)


def test_a_cut_sweep_is_named_when_read(own):
    file = own / "velodyne_points/data/0000000000.bin"
    file.write_bytes(file.read_bytes()[:-4])
    with pytest.raises(ValueError, match="0000000000.bin is cut off"):
        open_log(own).sweeps[0].read()


def test_a_drive_without_tracklets_or_lidar_is_a_drive(own):
    (own / "tracklet_labels.xml").write_text("<boost_serialization>")
    with pytest.raises(ValueError, match="tracklet_labels.xml is not as KITTI writes it"):
        open_log(own)
    (own / "tracklet_labels.xml").unlink()
    shutil.rmtree(own / "velodyne_points")
    log = open_log(own)
    assert log.tracks == () and log.sweeps == ()


def test_cameras_of_which_nothing_was_fetched_are_left_out(own):
    shutil.rmtree(own / "image_02" / "data")
    assert list(open_log(own).cameras) == ["image_03"]
    shutil.rmtree(own / "image_03" / "data")
    with pytest.raises(FileNotFoundError, match="no pictures in image_00/data to image_03/data; fetch"):
        open_log(own)


def test_an_unsynced_drive_is_refused_with_the_fix(own):
    extract = own.rename(own.with_name("2011_09_26_drive_0001_extract"))
    with pytest.raises(ValueError, match="fetch its _sync folder"):
        open_log(extract)


def test_a_sequence_without_poses_is_refused_with_the_fix(own_sequence):
    poses = own_sequence.parents[1] / "poses/04.txt"
    poses.write_text("\n".join(poses.read_text().splitlines()[:3]) + "\n")
    with pytest.raises(ValueError, match="3 poses for the 6 times"):
        open_log(own_sequence)
    poses.unlink()
    with pytest.raises(FileNotFoundError, match="poses/04.txt is missing; KITTI publishes poses of the sequences 00 to 10"):
        open_log(own_sequence)


def rewritten(path, change):
    """The numbers of a text file's rows, changed; names before them stay."""
    lines = []
    for line in path.read_text().splitlines():
        name, colon, rest = line.rpartition(": ")
        try:
            lines.append(name + colon + change(name, [float(word) for word in rest.split()]))
        except ValueError:
            lines.append(line)
    path.write_text("\n".join(lines) + "\n")


def test_poses_of_four_decimals_are_rigid(own_sequence, odometry):
    rewritten(own_sequence.parents[1] / "poses/04.txt", lambda _, row: " ".join(f"{v:.4f}" for v in row))
    rewritten(own_sequence / "calib.txt", lambda name, row: " ".join((f"{v:.4f}" if name == "Tr" else f"{v:.12e}") for v in row))
    found, whole = (open_log(path).camera("image_2").world_from_cam for path in (own_sequence, odometry))
    off = found[:, :3, :3] @ found[:, :3, :3].mT - torch.eye(3, dtype=torch.float64)
    assert off.abs().max() < 1e-9 and (found - whole).abs().max() < 2e-3


@pytest.mark.parametrize(
    ("file", "name", "scale"), [("poses/04.txt", "", 2.0), ("poses/04.txt", "", -1.0), ("sequences/04/calib.txt", "Tr", 2.0)]
)
def test_poses_that_are_no_rotations_are_named(own_sequence, file, name, scale):
    rewritten(own_sequence.parents[1] / file, lambda n, row: " ".join(f"{v * scale if n == name else v}" for v in row))
    with pytest.raises(ValueError, match=f"{file.split('/')[-1]}.*: pose.* is no rotation and place"):
        open_log(own_sequence)


def test_calibrations_that_are_none_are_named(own, own_sequence):
    rewritten(own.parent / "calib_velo_to_cam.txt", lambda name, row: " ".join(f"{2 * v if name == 'R' else v}" for v in row))
    with pytest.raises(ValueError, match="calib_velo_to_cam.txt: pose is no rotation"):
        open_log(own)
    rewritten(own_sequence / "calib.txt", lambda name, row: " ".join(f"{0 * v if name == 'P2' else v}" for v in row))
    with pytest.raises(ValueError, match="calib.txt, P2: fx must be a positive number"):
        open_log(own_sequence)


def test_times_that_stand_still_are_named(own_sequence):
    (own_sequence / "times.txt").write_text("0\n" * 6)
    with pytest.raises(ValueError, match="times.txt must have seconds that rise strictly"):
        open_log(own_sequence)
