import json
from contextlib import contextmanager
from dataclasses import replace

import pytest
import torch
from randomized import asset

from scenes import Databank, load
from scenes.names import slug
from scenes.usd.layers import usd_problems


@pytest.fixture
def bank(tmp_path) -> Databank:
    bank = Databank(tmp_path / "databank")
    for i, label in enumerate(["Car", "Pedestrian with Object", "Car"]):
        bank.add(asset(i, label), b"\x89PNG" if i else None)
    return bank


def test_ids_count_up_within_a_class(bank):
    assert [e.id for e in bank.entries()] == ["car/0001", "car/0002", "pedestrian-with-object/0001"]
    assert bank.add(asset(4, "car")) == "car/0003"


def test_labels_become_class_folders():
    labels = {"Car": "car", "Pedestrian with Object": "pedestrian-with-object", "Bus / Tram": "bus-tram", "../x": "x", "Ü": "thing"}
    assert {label: slug(label) for label in labels} == labels


def test_the_folder_is_laid_out_as_designed(bank):
    files = {str(p.relative_to(bank.path)) for p in bank.path.rglob("*") if p.is_file()}
    assert files == {
        "index.json", "assets/car/0001/asset.usdc", "assets/car/0001/asset.json", "assets/car/0002/asset.usdc",
        "assets/car/0002/asset.json", "assets/car/0002/thumb.png", "assets/pedestrian-with-object/0001/asset.usdc",
        "assets/pedestrian-with-object/0001/asset.json", "assets/pedestrian-with-object/0001/thumb.png",
    }  # fmt: skip
    assert json.loads((bank.path / "assets/car/0001/asset.json").read_text())["meta"] == asset().meta


def test_an_entry_says_what_the_asset_is(bank):
    entry = bank.entry("car/0002")
    assert (entry.label, entry.splats, entry.views, entry.licence, entry.attribution) == ("Car", 6, 7, "CC BY 4.0", "PandaSet")
    assert entry.size == tuple(asset().size.tolist()) and entry.thumb == "assets/car/0002/thumb.png"
    assert bank.entry("car/0001").thumb is None


def test_an_asset_returns_with_its_id(bank):
    before, after = asset(2, "Car"), bank.load("car/0002")
    assert torch.equal(after.gaussians.means, before.gaussians.means) and after.meta == before.meta | {"id": "car/0002"}
    assert load(bank.path / "assets/car/0002").meta == before.meta


def test_usds_own_validators_find_nothing(bank):
    for file in bank.path.rglob("*.usdc"):
        assert usd_problems(file) == []


def test_an_unknown_id_offers_the_nearest(bank):
    with pytest.raises(ValueError, match="car/0009.*it has car/0001.*Did you mean car/000"):
        bank.load("car/0009")
    with pytest.raises(ValueError, match="is a databank; load one of its assets: car/0001"):
        load(bank.path)


def test_a_missing_file_is_named(bank):
    (bank.path / "assets/car/0001/asset.usdc").unlink()
    with pytest.raises(FileNotFoundError, match="car/0001 .*lacks its file .*assets/car/0001/asset.usdc"):
        bank.load("car/0001")


def test_no_databank_is_said(tmp_path):
    with pytest.raises(FileNotFoundError, match="is not a databank"):
        Databank(tmp_path / "nowhere").entries()
    (tmp_path / "file").touch()
    with pytest.raises(NotADirectoryError, match="file is a file; --databank names a folder"):
        Databank(tmp_path / "file").entries()


@pytest.mark.parametrize(
    "spoil",
    [
        lambda text: text[:50],
        lambda text: "[]",
        lambda text: text.replace("sidestep databank", "other"),
        lambda text: text.replace('"splats"', '"spots"'),
        lambda text: text.replace("assets/car/0001/asset.usdc", "../../secret.usdc"),
        lambda text: text.replace("assets/car/0001/asset.usdc", "/secret.usdc"),
    ],
)
def test_a_corrupt_index_is_refused_also_by_add(bank, spoil):
    index = bank.path / "index.json"
    index.write_text(spoil(index.read_text()))
    before = index.read_text()
    for use in (bank.entries, lambda: bank.add(asset())):
        with pytest.raises(ValueError, match="index.json is corrupt"):
            use()
    assert index.read_text() == before


def test_an_add_that_breaks_off_leaves_the_databank_as_it_was(bank, monkeypatch):
    def fail(*_, **__):
        raise OSError(28, "No space left on device")

    before = {p: p.read_bytes() for p in bank.path.rglob("*") if p.is_file()}
    monkeypatch.setattr("scenes.usd.splats.author_splats", fail)
    with pytest.raises(OSError, match="No space"):
        bank.add(asset())
    assert {p: p.read_bytes() for p in bank.path.rglob("*") if p.is_file()} == before
    monkeypatch.undo()
    assert bank.add(asset()) == "car/0003"


def test_an_asset_that_the_index_has_no_room_for_leaves_no_folder(bank, monkeypatch):
    """As on a disk that the asset has filled to its last byte."""

    @contextmanager
    def full(_):
        raise OSError(28, "No space left on device")
        yield

    before = {p: p.read_bytes() for p in bank.path.rglob("*") if p.is_file()}
    monkeypatch.setattr("scenes.databank.atomic_file", full)
    for label in ("Car", "Truck"):
        with pytest.raises(OSError, match="No space"):
            bank.add(asset(4, label))
    assert {p: p.read_bytes() for p in bank.path.rglob("*") if p.is_file()} == before
    assert sorted(p.name for p in (bank.path / "assets").glob("*/*")) == ["0001", "0001", "0002"]


def test_an_add_that_fails_leaves_no_folder(tmp_path):
    bad = replace(asset(), meta={"psnr_unseen": float("nan")})
    with pytest.raises(ValueError, match="meta cannot be stored as JSON"):
        Databank(tmp_path / "new").add(bad)
    assert not (tmp_path / "new").exists()


def test_a_folder_that_could_not_be_written_is_taken_away(bank, monkeypatch):
    monkeypatch.setattr("scenes.usd.splats.author_splats", lambda *_, **__: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        bank.add(asset(4, "Truck"))
    assert not (bank.path / "assets/truck").exists()


def test_an_index_that_was_lost_is_made_anew_of_what_the_assets_say(bank):
    before = bank.entries()
    (bank.path / "index.json").unlink()
    assert bank.add(asset(4, "car")) == "car/0003"
    assert [e for e in bank.entries() if e.id != "car/0003"] == before
    (bank.path / "index.json").unlink()
    (bank.path / "assets/car/0001/asset.json").write_text("{}")
    with pytest.raises(ValueError, match="car/0001/asset.json is corrupt: KeyError 'id'; restore it"):
        bank.add(asset())


def test_a_folder_that_a_killed_add_left_is_not_reused(bank):
    (bank.path / "assets/car/0007").mkdir()
    assert bank.add(asset()) == "car/0008"


def test_splats_that_are_not_finite_are_not_added(bank):
    bad = asset()
    bad.gaussians.means[3, 1] = float("inf")
    with pytest.raises(ValueError, match="asset 'Car': splat 3 has inf in means"):
        bank.add(bad)
    assert len(bank.entries()) == 3


def test_the_original_of_what_a_scene_holds_is_of_its_id_class_and_size(bank, tmp_path):
    """Another databank's asset of that id is another thing."""
    mine = bank.load("car/0002")
    found = bank.original(replace(mine, gaussians=mine.gaussians.select(torch.arange(2))))
    assert found is not None and len(found.gaussians) == 6, "with all its detail"
    others = [
        replace(mine, label="Truck"),
        replace(mine, size=mine.size * 1.1),
        replace(mine, meta={"id": "car/3"}),
        replace(mine, meta={}),
    ]
    assert [bank.original(other) for other in others] == [None] * 4
    assert Databank(tmp_path / "none").original(mine) is None
