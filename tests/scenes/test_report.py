import json
from dataclasses import replace

import pytest
import torch
from randomized import asset, gaussians, scene, trajectory

from scenes import Actor, Databank, Gaussians, add_edit, describe, load, save, validate
from scenes.files import Dropping
from scenes.report import summary


@pytest.fixture
def saved(tmp_path):
    save(scene(), tmp_path / "s1")
    return tmp_path / "s1"


@pytest.fixture
def bank(tmp_path):
    bank = Databank(tmp_path / "databank")
    bank.add(asset(), b"png")
    bank.add(asset(1, "Bus"))
    return bank.path


def text(path) -> str:
    return "\n".join(summary(describe(path)))


def test_a_scene_is_described(saved):
    add_edit(saved, "first", [Actor(asset(), trajectory(3), "bus")], {})
    told = describe(saved)
    assert list(told)[:3] == ["path", "kind", "bytes"] and told["kind"] == "scene"
    assert told["bytes"] == sum(p.stat().st_size for p in saved.rglob("*") if p.is_file())
    assert (told["splats"], told["sh_degree"], told["sky"], told["ground"]) == (40, 2, "32x16", "7x5 cells of 0.3 m")
    assert [c["name"] for c in told["cameras"]] == ["front camera", "left"] and told["cameras"][0]["frames"] == 12
    assert [a["track"] for a in told["actors"] if a["inserted"]] == ["bus"] and told["edits"] == [{"name": "first"}]
    assert told["licence"] == "CC BY 4.0" and told["attribution"] == "Hesai and Scale AI"
    json.dumps(told)
    lines = text(saved)
    for part in ("veh_12", "4.10x1.80x1.50 m", "front camera", "1920", "inserted", "CC BY 4.0", "0 to 1.1 s"):
        assert part in lines, part
    assert describe(saved / "scene.usda") == told


def test_who_tells_a_drives_times_is_said_before_its_cameras(tmp_path):
    save(replace(scene(), meta={**scene().meta, "clock": "made up, 0.5 s from one picture to the next"}), tmp_path / "s1")
    lines = text(tmp_path / "s1").splitlines()
    (clock,) = [i for i, line in enumerate(lines) if "made up, 0.5 s" in line]
    assert lines[clock].startswith("clock  ") and clock < next(i for i, line in enumerate(lines) if line.startswith("cameras"))


def test_a_databank_an_asset_and_splats_are_described(bank, tmp_path):
    assert [e["id"] for e in describe(bank)["entries"]] == ["bus/0001", "car/0001"]
    assert "car/0001" in text(bank) and "6 splats" in text(bank) and "7 views" in text(bank)
    assert describe(bank / "assets/car/0001")["label"] == "Car" and "CC BY 4.0" in text(bank / "assets/car/0001/asset.usdc")
    save(gaussians(7), tmp_path / "a.ply")
    told = describe(tmp_path / "a.ply")
    assert (told["kind"], told["splats"], told["invalid_splats"]) == ("splats", 7, 0)
    assert told["bounds"] == [gaussians(7).means.amin(0).tolist(), gaussians(7).means.amax(0).tolist()]


def test_records_in_the_metadata_are_counted_not_spelt_out():
    meta = {"parked": [{"track": "veh_1", "size": [5.2, 2.0, 1.9]}] * 60, "world_origin": [0.0, 0.0]}
    assert summary({"meta": meta}) == ["meta           parked (60 entries, see --json)  world_origin [0.0, 0.0]"]


def test_an_empty_splat_file_is_described(tmp_path):
    save(Gaussians.empty(), tmp_path / "a.ply")
    assert describe(tmp_path / "a.ply")["bounds"] is None and text(tmp_path / "a.ply")


def test_a_path_that_does_not_exist_offers_the_nearest(saved):
    with pytest.raises(FileNotFoundError, match="s2 does not exist. Did you mean s1?"):
        describe(saved.parent / "s2")
    with pytest.raises(FileNotFoundError, match="s2 does not exist"):
        validate(saved.parent / "s2")


def test_what_sidestep_wrote_is_valid(saved, bank, tmp_path):
    add_edit(saved, "first", [Actor(asset(), trajectory(3), "bus")], {})
    save(gaussians(), tmp_path / "a.ply")
    save(gaussians(), tmp_path / "a.usdc")
    for path in (saved, bank, bank / "assets/car/0001", tmp_path / "a.ply", tmp_path / "a.usdc"):
        assert validate(path) == [], path


def test_a_deleted_edit_is_a_warning_and_a_problem(saved):
    add_edit(saved, "first", [Actor(asset(), trajectory(3), "bus")], {})
    (saved / "edits" / "first.usda").unlink()
    assert describe(saved)["warnings"] == ["edit first is missing: its file was deleted"]
    assert any(f"sidestep edit {saved} --undo first" in p for p in validate(saved))


def test_what_a_killed_edit_was_writing_is_no_edit(saved):
    (saved / "edits").mkdir(exist_ok=True)
    (saved / "edits" / ".first.a1b2c3d4.usda").write_text("#usda 1.0\n(")
    assert validate(saved) == []
    (saved / "edits" / "second.usda").write_text("#usda 1.0\n(")
    assert any("second.usda" in problem for problem in validate(saved))


def test_bad_splats_are_problems_and_counted(tmp_path, monkeypatch):
    g = gaussians(6)
    g.means[4, 0], g.quats[2], g.log_scales[3] = float("nan"), 0, 15.0
    monkeypatch.setattr(Gaussians, "validate", lambda *_: None)
    save(g, tmp_path / "a.ply")
    monkeypatch.undo()
    told, problems = describe(tmp_path / "a.ply"), validate(tmp_path / "a.ply")
    assert told["invalid_splats"] == 2 and "invalid splats" in text(tmp_path / "a.ply")
    assert len(problems) == 2 and "splat 4 has nan in means" in problems[0] and "splat 3 has the scales 3.27e+06" in problems[1]
    dropping = Dropping()
    assert len(validate(tmp_path / "a.ply", dropping)) == 1 and dropping.count == 2


def test_missing_and_foreign_files_are_problems(saved, bank, tmp_path):
    (saved / "sky_linear.hdr").unlink()
    assert any("sky_linear.hdr" in p for p in validate(saved))
    (bank / "assets/car/0001/asset.usdc").unlink()
    (bank / "assets/car/0001/thumb.png").unlink()
    assert [p.split("/")[-1] for p in validate(bank)] == ["asset.usdc", "thumb.png"]
    assert describe(bank)["warnings"] == [f"car/0001 lacks {bank / 'assets/car/0001' / name}" for name in ("asset.usdc", "thumb.png")]
    (tmp_path / "a.ply").write_text("hello")
    (tmp_path / "a.txt").write_text("hello")
    (tmp_path / "folder").mkdir()
    assert all(len(validate(tmp_path / name)) == 1 for name in ("a.ply", "a.txt", "folder"))


def test_an_assets_own_entry_that_is_lost_or_empty_is_a_problem(bank):
    (bank / "assets/car/0001/asset.json").write_text("{}")
    (bank / "assets/bus/0001/asset.json").unlink()
    lost, corrupt = validate(bank)
    assert lost == f"bus/0001 lacks its file {bank / 'assets/bus/0001/asset.json'}" and "car/0001/asset.json is corrupt" in corrupt


def test_an_index_that_disagrees_with_an_asset_is_a_problem(bank):
    index = bank / "index.json"
    index.write_text(index.read_text().replace('"splats": 6', '"splats": 7'))
    assert len(validate(bank)) == 2 and "differs from what index.json says" in validate(bank)[0]
    index.write_text(json.dumps(json.loads(index.read_text()) | {"entries": []}))
    assert [p.endswith("is not in index.json") for p in validate(bank)] == [True, True]


def test_impossible_scenes_are_problems(tmp_path):
    bad = scene()
    bad.rig["left"].exposure[0, 0] = float("nan")
    bad.ground.heights[1, 1] = float("inf")
    object.__setattr__(bad.rig["left"], "times_us", torch.tensor([0, int(bad.ego.times_us[0])]))
    bad.rig["left"].exposure.nan_to_num_(1.0)
    save(bad, tmp_path / "s1")
    problems = validate(tmp_path / "s1")
    assert any("camera left took 1 frames" in p for p in problems)
    assert any("the ground has heights that are not finite" in p for p in problems)


def test_a_camera_whose_times_fall_is_a_problem(tmp_path):
    bad = scene()
    times = bad.rig["front camera"].times_us.clone()
    times[[2, 3]] = times[[3, 2]]
    object.__setattr__(bad.rig["front camera"], "times_us", times)
    save(bad, tmp_path / "s1")
    assert validate(tmp_path / "s1") == [
        f"{tmp_path / 's1'}: the times of camera front camera must rise, but frame 3 is taken no later than the one before"
    ]


GOOD = {"track": "veh_7", "label": "car", "size": [4.2, 1.8, 1.5], "world_from_box": torch.eye(4).tolist()}


@pytest.mark.parametrize(
    "damage",
    [{"track": None}, {"size": [4.2, 1.8]}, {"size": [4.2, 1.8, "wide"]}, {"world_from_box": [[1.0]]}, {"size": [4.2, 1.8, float("nan")]}],
    ids=lambda damage: next(iter(damage)),
)
def test_a_damaged_parked_vehicle_is_named_and_refused(tmp_path, damage):
    save(replace(scene(), meta={"parked": [GOOD, GOOD]}), tmp_path / "s1")
    assert validate(tmp_path / "s1") == []
    file = tmp_path / "s1" / "metadata.json"
    told = json.loads(file.read_text())
    told["meta"]["parked"][1] |= damage
    file.write_text(json.dumps(told))
    (problem,) = validate(tmp_path / "s1")
    assert "metadata.json is corrupt: entry 1 of parked needs a track, a label, a size of 3" in problem
    del told["meta"]["parked"][1]["size"]
    file.write_text(json.dumps(told))
    with pytest.raises(ValueError, match="entry 1 of parked"):
        load(tmp_path / "s1")


def test_a_path_among_the_meta_does_not_fill_the_terminal(street, tmp_path):
    poses = street.ego.world_from_body.tolist()
    save(replace(street, meta={**street.meta, "path_correction": {"times_us": [1, 2], "poses": poses}}), tmp_path / "s1")
    lines = summary(describe(tmp_path / "s1"))
    assert max(map(len, lines)) < 600 and any("path_correction (2 entries, see --json)" in line for line in lines)
