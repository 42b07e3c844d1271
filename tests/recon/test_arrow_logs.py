"""The readers of data sets that come as Arrow tables: Argoverse 2 (feather) and Waymo (parquet)."""

import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

pytest.importorskip("pyarrow", reason="needs pyarrow: pip install 'sidestep[arrow]'")

from made_argoverse2 import NAMES as RING  # noqa: E402
from made_argoverse2 import write_argoverse2  # noqa: E402
from made_tape import STAMPS, STEP_US, check, tape  # noqa: E402
from made_waymo import NAMES as FIVE  # noqa: E402
from made_waymo import READOUT_US, SEGMENT, near_points, write_waymo  # noqa: E402

from recon import open_log  # noqa: E402
from recon.objects.tracks import nearness  # noqa: E402
from recon.readers.arrow import Rows  # noqa: E402
from recon.readers.waymo import BODY, POSE, STAMP, _from_range, _rotations, read_waymo  # noqa: E402
from scenes.lenses import OpenCV, Pinhole  # noqa: E402
from scenes.poses import inverse, pose_from, translation, yaw  # noqa: E402
from tests.layouts.waymo import MAP  # noqa: E402


@pytest.fixture(scope="module")
def recorded(street):
    return tape(street)


@pytest.fixture(scope="module")
def near(recorded):
    return replace(recorded, points=near_points(recorded))


@pytest.fixture(scope="module")
def argoverse(recorded, tmp_path_factory):
    return write_argoverse2(tmp_path_factory.mktemp("av2") / "0b97", recorded)


@pytest.fixture(scope="module")
def waymo(near, tmp_path_factory):
    return write_waymo(tmp_path_factory.mktemp("waymo") / "training", near)


@pytest.fixture
def own_argoverse(argoverse, tmp_path):
    return shutil.copytree(argoverse, tmp_path / "0b97")


@pytest.fixture
def own_waymo(waymo, tmp_path):
    return shutil.copytree(waymo, tmp_path / "training")


def test_an_argoverse_log_reads_as_it_was_recorded(argoverse, recorded):
    log = open_log(argoverse)
    check(log, recorded, RING, atol=1e-5)
    assert log.front == ("ring_front_center", "ring_front_right") and len(log.tracks) == 2
    assert isinstance(log.camera("ring_front_center").lens, Pinhole)  # its pictures are published undistorted
    points, stamp = log.sweeps[0].read(), log.sweeps[0].time_us
    assert points.sensor.tolist() == [i % 64 // 32 for i in range(len(points.xyz))]
    np.testing.assert_allclose(points.times_us - stamp, np.linspace(0, STEP_US, len(points.xyz)), atol=1)  # as they were written


def test_a_waymo_segment_reads_as_it_was_recorded(waymo, near):
    log = open_log(waymo / SEGMENT)
    check(log, near, FIVE, atol=5e-4, lidar=0.1)  # the middle row's moment lies between the poses that are published
    assert log.front == ("front", "front_right") and len(log.tracks) == 2
    assert isinstance(log.camera("front").lens, OpenCV)
    shutters = {name: (c.shutter, c.readout_us) for name, c in log.cameras.items()}
    assert shutters == {"front": ("rows", READOUT_US), "front_right": ("columns", -READOUT_US)}  # the right one from right to left
    assert log.rig({"front_right": (96, 54)})["front_right"].times_us[0] == log.camera("front_right").times_us[0] + READOUT_US // 2
    assert open_log(waymo).name == log.name  # the only segment needs no name


def test_waymo_lenses_bend_as_their_calibration_says(own_waymo):
    bent = {"k1": 0.1, "k2": -0.02, "p1": 0.003, "p2": -0.004, "k3": 0.005}
    columns = {f"[CameraCalibrationComponent].intrinsic.{k}": value for k, value in bent.items()}
    changed(own_waymo / f"camera_calibration/{SEGMENT}.parquet", lambda table: table.assign(**columns))
    lens = open_log(own_waymo / SEGMENT).camera("front").lens
    assert {k: getattr(lens, k) for k in bent} == pytest.approx(bent)


def test_argoverse_boxes_stand_where_each_alone_is_placed(own_argoverse):
    """One that the path does not cover is left out."""
    import pandas as pd

    path = own_argoverse / "annotations.feather"
    table = pd.read_feather(path)
    late = table.iloc[:1].assign(timestamp_ns=table["timestamp_ns"].max() + 10**9)
    pd.concat([table, late], ignore_index=True).to_feather(path)
    log = open_log(own_argoverse)
    for track in log.tracks:
        rows = table[table["track_uuid"] == track.sources[0]].to_dict("records")
        assert track.times_us.tolist() == [row["timestamp_ns"] // 1000 for row in rows]
        for row, pose in zip(rows, track.world_from_box, strict=True):
            local = pose_from([row[f"q{k}"] for k in "wxyz"], [row[f"t{k}_m"] for k in "xyz"])
            alone = log.ego.at(row["timestamp_ns"] // 1000) @ local @ translation(0.0, 0.0, -row["height_m"] / 2)
            torch.testing.assert_close(pose, alone, atol=1e-9, rtol=0)


def test_waymo_boxes_stand_where_each_alone_is_placed(waymo):
    import pandas as pd

    log = open_log(waymo / SEGMENT)
    table = pd.read_parquet(waymo / f"lidar_box/{SEGMENT}.parquet")
    frames = dict(zip(STAMPS.tolist(), log.ego.world_from_body[1:-1], strict=True))
    for track in log.tracks:
        rows = table[table["key.laser_object_id"] == track.sources[0]]
        keys = [f"[LiDARBoxComponent].box.{k}" for k in ("center.x", "center.y", "center.z", "size.z", "heading")]
        values = zip(rows["key.frame_timestamp_micros"], rows[keys].to_numpy(), track.world_from_box, strict=True)
        for t, (x, y, z, height, heading), pose in values:
            alone = frames[t] @ translation(x, y, z - height / 2) @ yaw(heading)
            torch.testing.assert_close(pose, alone, atol=1e-9, rtol=0)


def test_a_waymo_frames_pose_is_that_of_its_front_picture(own_waymo, near):
    """Its stamp is that of the first lidar column (waymo-open-dataset, issue 464): at 15 m/s the car is 0.7 m farther at the pose."""
    import pandas as pd

    images = pd.read_parquet(own_waymo / f"camera_image/{SEGMENT}.parquet")
    front = images[images["key.camera_name"] == 1]
    log = open_log(own_waymo / SEGMENT)
    assert log.ego.times_us[1:-1].tolist() == (front[STAMP] * 1e6).round().astype(int).to_list()
    boxes = pd.read_parquet(own_waymo / f"lidar_box/{SEGMENT}.parquet")
    for track in log.tracks:
        rows = boxes[boxes["key.laser_object_id"] == track.sources[0]]
        assert track.times_us.tolist() == rows["key.frame_timestamp_micros"].to_list()
        x, y = (rows[f"[LiDARBoxComponent].box.center.{k}"].to_numpy() for k in "xy")
        local = torch.linalg.inv(log.ego.world_from_body[1:-1]) @ track.world_from_box
        np.testing.assert_allclose(local[:, :2, 3], np.stack([x, y], 1), atol=1e-9)
    poses = [(MAP @ near.ego.at(t)).numpy().ravel() for t in STAMPS.tolist()]
    changed(own_waymo / f"vehicle_pose/{SEGMENT}.parquet", lambda table: table.assign(**{BODY: poses}))
    assert open_log(own_waymo / SEGMENT).ego.times_us[1:-1].tolist() == STAMPS.tolist(), "no picture has these"


def test_waymo_points_were_taken_when_the_car_passed_by_their_pixels_pose(waymo, near):
    log = read_waymo(waymo / SEGMENT)
    home = near.ego.at(int(log.ego.times_us[1])) @ inverse(log.ego.world_from_body[1])
    for sweep in log.sweeps:
        local, points = near.scan(sweep.time_us, STEP_US), sweep.read()
        wanted = sweep.time_us + np.arctan2(local[:, 1], local[:, 0]) / (2 * np.pi) * STEP_US
        which = cKDTree(near.points).query(points.xyz @ home[:3, :3].numpy().T + home[:3, 3].numpy())[1]
        assert np.abs(points.times_us - wanted[which]).max() < 3000


def test_the_way_to_a_box_and_to_a_camera_is_that_of_each_moment_alone(argoverse):
    log = open_log(argoverse)
    for track in log.tracks:
        ways = [inverse(log.ego.at(t)) @ pose for t, pose in zip(track.times_us.tolist(), track.world_from_box, strict=True)]
        assert nearness(track, log.ego) == pytest.approx(min(float(way[:3, 3].norm()) for way in ways), abs=1e-9)
        assert nearness(replace(track, times_us=track.times_us + 10**9), log.ego) == float("inf")
        late = replace(track, times_us=track.times_us + int(log.ego.span_us()[1] - track.times_us[0]))  # the first alone is covered
        first = inverse(log.ego.at(int(late.times_us[0]))) @ track.world_from_box[0]
        assert nearness(late, log.ego) == pytest.approx(float(first[:3, 3].norm()), abs=1e-9)
    for name, camera in log.cameras.items():
        alone = [inverse(log.ego.at(int(t))) @ pose for t, pose in zip(camera.times_us, camera.world_from_cam, strict=True)]
        torch.testing.assert_close(log.offsets(name), torch.stack(alone), atol=1e-9, rtol=0)


def unpacked(monkeypatch) -> list:
    """What row groups are unpacked from now on, as columns and the group's number."""
    from pyarrow import parquet

    seen, read = [], parquet.ParquetFile.iter_batches

    def noted(self, size, row_groups, columns):
        seen.append((*columns, *row_groups))
        return read(self, size, row_groups, columns)

    monkeypatch.setattr(parquet.ParquetFile, "iter_batches", noted)
    return seen


def test_sweeps_read_in_order_unpack_each_row_group_once(waymo, monkeypatch):
    seen = unpacked(monkeypatch)
    for sweep in open_log(waymo / SEGMENT).sweeps:
        sweep.read()
    assert len(seen) == len(set(seen)) == 6  # two groups each of the lidar, of its pixels' poses and of the vehicle's


@pytest.fixture
def rows_file(tmp_path):
    """Three rows each of ten stamps in groups of four, which part them; `image` has more numbers each row."""
    import pandas as pd

    stamps = np.repeat(np.arange(10) * 100, 3)
    table = pd.DataFrame({"image": [np.full(i + 1, i, np.float32) for i in range(30)], "key.stamp": stamps, "key.laser": np.arange(30) % 3})
    table.to_parquet(tmp_path / "rows.parquet", row_group_size=4)
    return tmp_path / "rows.parquet"


def test_rows_of_a_value_come_from_all_groups_that_have_some(rows_file, monkeypatch):
    seen = unpacked(monkeypatch)
    rows = Rows(rows_file, "key.stamp", ("key.laser", "image"))
    for stamp in range(10):
        found = rows.read(stamp * 100)
        assert list(found) == ["key.laser", "image"] and found["key.laser"].tolist() == [0, 1, 2]
        assert [image.tolist() for image in found["image"]] == [[i] * (i + 1) for i in range(3 * stamp, 3 * stamp + 3)]
    assert [group for *_, group in seen] == list(range(8))
    assert all(len(column) == 0 for column in rows.read(50).values()) and len(seen) == 8
    rows.read(0)
    assert seen[-1][-1] == 0 and len(seen) == 9  # no more than the last one is kept


def test_rows_are_those_that_the_file_has_now(rows_file):
    import pandas as pd

    rows = Rows(rows_file, "key.stamp", ("image",))
    rows.read(0)
    table = pd.read_parquet(rows_file)
    table.assign(image=[image + 1 for image in table["image"]]).iloc[:8].to_parquet(rows_file, row_group_size=4)
    assert rows.read(0)["image"][2].tolist() == [3, 3, 3]
    with pytest.raises(ValueError, match='rows.parquet has no column "range"; it has image, key.stamp, key.laser'):
        Rows(rows_file, "key.stamp", ("range",)).read(0)
    rows_file.write_bytes(rows_file.read_bytes()[:-20])
    with pytest.raises(ValueError, match="rows.parquet is cut off or corrupt"):
        rows.read(0)
    rows_file.unlink()
    with pytest.raises(FileNotFoundError, match="rows.parquet is missing"):
        rows.read(0)


def test_a_range_images_middle_column_looks_ahead_and_its_first_row_up():
    ranges = np.zeros((3, 4))
    ranges[0, 1], ranges[2, 3] = 10.0, 5.0
    xyz, hit = _from_range(ranges, np.eye(4), np.array([-0.3, 0.0, 0.2]), [-0.3, 0.2])
    assert hit.sum() == 2
    np.testing.assert_allclose(xyz[0], [10 * np.cos(0.2) * np.cos(np.pi / 4)] * 2 + [10 * np.sin(0.2)], atol=1e-12)
    np.testing.assert_allclose(xyz[1], [-5 * np.cos(0.3) * np.cos(np.pi / 4)] * 2 + [-5 * np.sin(0.3)], atol=1e-12)
    turned, _ = _from_range(ranges, np.array([[0.0, -1], [1, 0]]), None, [-0.3, 0.3])  # the lidar's own heading is taken back
    np.testing.assert_allclose(turned[0, :2] / np.linalg.norm(turned[0, :2]), [np.cos(np.pi / 4), -np.sin(np.pi / 4)], atol=1e-12)


def test_pixel_poses_turn_by_roll_then_pitch_then_yaw():
    from scipy.spatial.transform import Rotation

    angles = np.random.default_rng(0).uniform(-1, 1, (5, 3))
    np.testing.assert_allclose(_rotations(angles), Rotation.from_euler("xyz", angles).as_matrix(), atol=1e-12)


def test_a_segment_must_exist(own_waymo):
    with pytest.raises(ValueError, match=f'segment "10017_000" is not in .*; it has {SEGMENT}'):
        open_log(own_waymo / "10017_000")
    shutil.copy(own_waymo / f"vehicle_pose/{SEGMENT}.parquet", own_waymo / "vehicle_pose/other.parquet")
    with pytest.raises(ValueError, match="holds 2 segments"):
        open_log(own_waymo)


@pytest.mark.parametrize("kind", ["vehicle_pose", "camera_image", "camera_calibration", "lidar_pose", "lidar_calibration"])
def test_missing_and_cut_components_are_named(own_waymo, kind):
    path = own_waymo / kind / f"{SEGMENT}.parquet"
    whole = path.read_bytes()
    if not kind.startswith("lidar"):
        path.write_bytes(whole[: len(whole) // 2])
        with pytest.raises(ValueError, match=f"{kind}/.*is cut off or corrupt"):
            open_log(own_waymo / SEGMENT)
    if kind != "vehicle_pose":  # without it there is no segment
        path.unlink()
        with pytest.raises(FileNotFoundError, match=f"{kind}/.*is missing"):
            open_log(own_waymo / SEGMENT)


def test_segments_without_lidar_or_boxes_are_read(own_waymo):
    for kind in ("lidar", "lidar_box"):
        shutil.rmtree(own_waymo / kind)
    log = open_log(own_waymo / SEGMENT)
    assert log.sweeps == () and log.tracks == ()


@pytest.mark.parametrize(
    "file", ["city_SE3_egovehicle.feather", "calibration/intrinsics.feather", "calibration/egovehicle_SE3_sensor.feather"]
)
def test_missing_and_cut_feather_files_are_named(own_argoverse, file):
    path = own_argoverse / file
    path.write_bytes(path.read_bytes()[:100])
    with pytest.raises(ValueError, match=f"{path.name} is cut off or corrupt"):
        open_log(own_argoverse)
    path.unlink()
    with pytest.raises(FileNotFoundError, match=f"{path.name} is missing"):
        open_log(own_argoverse)


def test_a_column_that_is_missing_is_named(own_argoverse):
    import pandas as pd

    path = own_argoverse / "calibration/intrinsics.feather"
    pd.read_feather(path).drop(columns="fx_px").to_feather(path)
    with pytest.raises(ValueError, match='intrinsics.feather has no column "fx_px"; it has sensor_name'):
        open_log(own_argoverse)


def test_a_log_of_the_test_split_has_no_boxes(own_argoverse):
    (own_argoverse / "annotations.feather").unlink()
    shutil.rmtree(own_argoverse / "sensors/cameras/ring_front_right")
    log = open_log(own_argoverse)
    assert log.tracks == () and list(log.cameras) == ["ring_front_center"]


def test_without_pyarrow_the_fix_is_named(argoverse, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(ValueError, match=r"pip install 'sidestep\[arrow\]'"):
        open_log(argoverse)


def test_pictures_come_from_a_row_of_the_parquet_file(waymo, near):
    camera = open_log(waymo / SEGMENT).camera("front_right")
    truth = [near.image("right", int(t)) for t in camera.times_us]
    off = torch.tensor([[float(np.abs(camera.image(i).astype(int) - t).mean()) for t in truth] for i in range(len(truth))])
    assert off.argmin(1).tolist() == list(range(len(truth)))


def changed(path, change):
    """A table's file with its frame changed."""
    import pandas as pd

    feather = path.suffix == ".feather"
    frame = change((pd.read_feather if feather else pd.read_parquet)(path))
    (frame.to_feather if feather else frame.to_parquet)(path)


def test_argoverse_rows_that_are_wrong_or_lost_are_named(own_argoverse):
    poses, lenses = own_argoverse / "city_SE3_egovehicle.feather", own_argoverse / "calibration/intrinsics.feather"
    whole = poses.read_bytes()
    changed(poses, lambda table: table.iloc[:0])
    with pytest.raises(ValueError, match="city_SE3_egovehicle.feather has no row"):
        open_log(own_argoverse)
    poses.write_bytes(whole)
    changed(poses, lambda table: table.assign(qw=0.0, qx=0.0, qy=0.0, qz=0.0))
    with pytest.raises(ValueError, match="city_SE3_egovehicle.feather: pose 0 is not finite or has no rotation"):
        open_log(own_argoverse)
    poses.write_bytes(whole)
    changed(lenses, lambda table: table.assign(cx_px=float("nan")))
    with pytest.raises(ValueError, match="intrinsics.feather, ring_.*: cx of a lens must be finite"):
        open_log(own_argoverse)


def test_waymo_poses_are_rounded_or_refused(own_waymo, waymo):
    for kind, column in (("vehicle_pose", BODY), ("camera_image", POSE)):
        changed(own_waymo / kind / f"{SEGMENT}.parquet", lambda table, c=column: table.assign(**{c: [np.round(p, 4) for p in table[c]]}))
    found, whole = (open_log(root / SEGMENT) for root in (own_waymo, waymo))
    assert torch.equal(found.ego.times_us, whole.ego.times_us)  # pictures are still known by having their frame's pose
    for name, camera in found.cameras.items():
        turns = camera.world_from_cam[:, :3, :3]
        assert (turns @ turns.mT - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-9
        assert (camera.world_from_cam - whole.camera(name).world_from_cam).abs().max() < 1e-3
    file = own_waymo / "vehicle_pose" / f"{SEGMENT}.parquet"
    changed(file, lambda table: table.assign(**{BODY: [np.diag([2.0, 2, 2, 1]).ravel() for _ in table[BODY]]}))
    with pytest.raises(ValueError, match=f"vehicle_pose/{SEGMENT}.parquet: pose is no rotation"):
        open_log(own_waymo / SEGMENT)
    changed(file, lambda table: table.iloc[:0])
    with pytest.raises(ValueError, match=f"vehicle_pose/{SEGMENT}.parquet has no row"):
        open_log(own_waymo / SEGMENT)


def test_a_sweep_without_its_frames_pose_is_named_when_read(own_waymo):
    changed(own_waymo / "vehicle_pose" / f"{SEGMENT}.parquet", lambda table: table.iloc[1:])
    log = open_log(own_waymo / SEGMENT)
    with pytest.raises(ValueError, match="vehicle_pose/.* has no pose at .*, of which lidar/ has a sweep"):
        log.sweeps[0].read()
