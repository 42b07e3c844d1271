import json
import shutil
import tracemalloc

import numpy as np
import pytest
from made_nuscenes import NAMES, write_nuscenes
from made_tape import BODY_FROM_LIDAR, check, tape

from recon import open_log
from recon.readers import nuscenes
from recon.readers.nuscenes import Tables, label_of


@pytest.fixture(scope="module")
def recorded(street):
    return tape(street)


@pytest.fixture(scope="module")
def data_set(recorded, tmp_path_factory):
    return write_nuscenes(tmp_path_factory.mktemp("data") / "nuscenes", recorded)


@pytest.fixture
def own(data_set, tmp_path):
    return shutil.copytree(data_set, tmp_path / "nuscenes")


def test_a_scene_reads_as_it_was_recorded(data_set, recorded):
    log = open_log(data_set / "scene-0061")
    check(log, recorded, NAMES)
    assert log.front == ("CAM_FRONT", "CAM_FRONT_RIGHT") and len(log.tracks) == 2 and log.name == "nuscenes-scene-0061"
    assert log.meta["heights"] is False


@pytest.mark.parametrize(("late", "known"), [({"CAM_FRONT": -35_278, "CAM_FRONT_RIGHT": -35_278}, True), ({}, False)])
def test_points_were_taken_when_the_lidar_looked_there(own, recorded, late, known):
    """Cameras are triggered as the lidar comes by; it ends 106 degrees left of ahead where those that look ahead are 35.3 ms early."""
    path = own / "v1.0-mini" / "sample_data.json"
    rows = json.loads(path.read_text())
    stamps = {row["sample_token"]: row["timestamp"] for row in rows if "LIDAR" in row["filename"]}
    for row in rows:
        channel = row["filename"].split("/")[1]
        row["timestamp"] = stamps[row["sample_token"]] + late[channel] if channel in late else row["timestamp"]
    path.write_text(json.dumps(rows))
    sweep = open_log(own / "scene-0061").sweeps[0]
    local = recorded.scan(sweep.time_us) @ BODY_FROM_LIDAR[:3, :3].numpy().T
    right = (np.radians(106) - np.arctan2(local[:, 1], local[:, 0])) % (2 * np.pi)
    wanted = 50_000 * (right / (2 * np.pi) - 1) if known else np.zeros(len(local))
    assert np.abs(sweep.read().times_us - sweep.time_us - wanted).max() < 100


def test_boxes_are_of_the_moment_of_their_samples_own_sweep(own, data_set):
    path = own / "v1.0-mini" / "sample.json"
    path.write_text(json.dumps([{**row, "timestamp": row["timestamp"] - 40_000} for row in json.loads(path.read_text())]))
    late, whole = (next(t for t in open_log(root / "scene-0061").tracks if t.moving).times_us for root in (own, data_set))
    assert (late - whole).tolist() == [0, 0, -40_000, 0, 0, 0], "the third has no sweep among the key frames"


def test_a_scene_must_be_named_and_exist(data_set):
    with pytest.raises(ValueError, match="holds 2 scenes .scene-0061, scene-0103.; name one, as .*scene-0061"):
        open_log(data_set)
    with pytest.raises(ValueError, match='scene "scene-0016" is not in .*Did you mean scene-0061'):
        open_log(data_set / "scene-0016")
    with pytest.raises(ValueError, match="has nothing of scene-0103"):
        open_log(data_set / "scene-0103")


def test_a_missing_picture_is_named(own):
    file = next((own / "samples/CAM_FRONT").iterdir())
    file.unlink()
    with pytest.raises(FileNotFoundError, match=f"{file.name} is missing"):
        open_log(own / "scene-0061")


@pytest.mark.parametrize("table", ["sample", "sample_data", "ego_pose", "calibrated_sensor", "sensor"])
def test_missing_and_wrong_tables_are_named(own, table):
    path = own / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    for key in ("token", "sample_token", "channel"):
        if key in rows[0]:
            path.write_text(json.dumps([{k: v for k, v in row.items() if k != key} for row in rows]))
    with pytest.raises(ValueError, match=f"{table}.json has rows without"):
        open_log(own / "scene-0061")
    path.write_text("[{")
    with pytest.raises(ValueError, match=f"{table}.json is not json"):
        open_log(own / "scene-0061")
    path.unlink()
    with pytest.raises(FileNotFoundError, match=f"{table}.json is missing"):
        open_log(own / "scene-0061")


@pytest.mark.parametrize("indent", [None, 0, 4])
def test_a_table_is_read_row_by_row_wherever_its_text_is_parted(tmp_path, monkeypatch, indent):
    rows = [{"token": f"ä{i}", "channel": 'a "]}, {[' * (i % 5)} for i in range(40)]
    (tmp_path / "sensor.json").write_text(json.dumps(rows, indent=indent, ensure_ascii=indent is None) + "\n", encoding="utf-8")
    for chunk in range(130, 190, 7):
        monkeypatch.setattr(nuscenes, "CHUNK", chunk)
        assert list(Tables(tmp_path).rows("sensor")) == rows
    (tmp_path / "sensor.json").write_text(" [ ]\n")
    assert list(Tables(tmp_path).rows("sensor")) == []


ROW = '{"token": "a", "channel": "b"}'


@pytest.mark.parametrize(
    "text", ["", "[", f"[{ROW}", f"[{ROW},", f"[{ROW},]", f"[{ROW} {ROW}]", f"[{ROW}]]", f"[] {ROW}", ROW, f"[{ROW[:-5]}", "[\xff]"]
)
def test_a_table_that_is_not_one_whole_list_is_refused(tmp_path, text):
    (tmp_path / "sensor.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ValueError, match="sensor.json is not json"):
        list(Tables(tmp_path).rows("sensor"))


@pytest.mark.parametrize("entry", ["1", "null", '["token"]', '{"token": "a"}'])
def test_an_entry_without_the_tables_keys_is_refused(tmp_path, entry):
    (tmp_path / "sensor.json").write_text(f"[{ROW}, {entry}]")
    with pytest.raises(ValueError, match='sensor.json has rows without "(token|channel)"'):
        list(Tables(tmp_path).rows("sensor"))


def test_a_long_table_takes_no_more_memory_than_a_short_one(tmp_path, monkeypatch):
    monkeypatch.setattr(nuscenes, "CHUNK", 1 << 14)
    (tmp_path / "sensor.json").write_text(json.dumps([{"token": f"{i}", "channel": 100 * "x"} for i in range(20_000)]))
    tracemalloc.start()
    try:
        assert [row["token"] for row in Tables(tmp_path).rows("sensor") if row["token"].endswith("9999")] == ["9999", "19999"]
        assert tracemalloc.get_traced_memory()[1] < (tmp_path / "sensor.json").stat().st_size / 10
    finally:
        tracemalloc.stop()


def test_the_test_part_has_no_boxes(own):
    (own / "v1.0-mini/sample_annotation.json").unlink()
    assert open_log(own / "scene-0061").tracks == ()


def test_categories_become_classes():
    names = ("vehicle.car", "vehicle.bus.rigid", "human.pedestrian.adult", "movable_object.trafficcone", "vehicle.construction", "animal")
    assert [label_of(n) for n in names] == ["car", "bus", "pedestrian", "cone", "construction-vehicle", "animal"]


@pytest.mark.parametrize(
    ("table", "changes", "said"),
    [
        ("ego_pose", {"rotation": [0, 0, 0, 0]}, "row .* of nuScenes' tables: pose is not finite or has no rotation"),
        ("ego_pose", {"translation": [float("nan"), 0, 0]}, "row .* of nuScenes' tables: pose is not finite"),
        ("ego_pose", {"rotation": [1, 0, 0]}, "row .* of nuScenes' tables has no pose"),
        ("ego_pose", None, "ego_pose.json has no row .*, which other tables name"),
        ("calibrated_sensor", None, "calibrated_sensor.json has no row"),
        ("sensor", None, "sensor.json has no row"),
        ("instance", None, "instance.json has no row"),
        ("calibrated_sensor", {"camera_intrinsic": []}, "calibrated_sensor.json, camera_intrinsic of CAM_FRONT"),
        (
            "calibrated_sensor",
            {"camera_intrinsic": [[float("nan"), 0, 5], [0, 9, 5], [0, 0, 1]]},
            "camera_intrinsic of CAM_FRONT.*: fx must be",
        ),
    ],
)
def test_rows_that_are_wrong_or_lost_are_named(own, table, changes, said):
    path = own / "v1.0-mini" / f"{table}.json"
    rows = json.loads(path.read_text())
    path.write_text(json.dumps(rows[1:] if changes is None else [{**row, **changes} for row in rows]))
    with pytest.raises(ValueError, match=said):
        open_log(own / "scene-0061")
