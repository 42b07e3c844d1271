"""Photos of assets on disk: beside the asset, in the databank, in edits."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from street import car

from scenes import Actor, Databank, Pinhole, load, save
from scenes.asset import AssetPhoto
from scenes.asset_photos import load_photos, photos_folder
from scenes.camera import Camera
from scenes.edit import Edit
from scenes.lenses import OpenCV
from scenes.poses import translation
from scenes.report import validate
from scenes.usd.edit import add_change, add_edit


def photo(value=200, lens=Pinhole(30.0, 31.0, 15.5, 10.25), time_us=1_500_000_000_000_007) -> AssetPhoto:  # noqa: B008 - frozen
    pixels = np.zeros((20, 32, 4), np.uint8)
    pixels[5:, 4:] = value, value // 2, 30, 255
    return AssetPhoto(Camera(lens, 32, 20, translation(-6.0, 0.1234567890123, 1.0), time_us=time_us), lambda: pixels)


@pytest.fixture
def pictured():
    return replace(car(), photos=(photo(), photo(90)))


def test_photos_come_back_with_their_cameras(pictured, tmp_path):
    save(pictured, tmp_path / "car.usdc")
    found = load(tmp_path / "car.usdc").photos
    assert len(found) == 2
    for a, b in zip(pictured.photos, found, strict=True):
        assert a.camera.lens == b.camera.lens and a.camera.time_us == b.camera.time_us
        assert torch.equal(a.camera.world_from_cam, b.camera.world_from_cam)
        wanted, got = a.read(), b.read()
        assert got.dtype == np.uint8 and np.array_equal(wanted[..., 3], got[..., 3])
        inner = (slice(8, -3), slice(8, -3))
        assert np.abs(wanted[inner].astype(int) - got[inner]).max() <= 6


def test_an_asset_without_photos_takes_the_place_of_one_with_them(pictured, tmp_path):
    save(pictured, tmp_path / "car.usdc")
    save(car(), tmp_path / "car.usdc", overwrite=True)
    assert not photos_folder(tmp_path / "car.usdc").exists() and load(tmp_path / "car.usdc").photos == ()


def test_a_folder_of_something_else_is_left_alone(pictured, tmp_path):
    """Though it has the name that photos would have, and holds pictures."""
    folder = photos_folder(tmp_path / "car.usdc")
    folder.mkdir()
    (folder / "beach.webp").write_bytes(b"a holiday")
    save(car(), tmp_path / "car.usdc")
    with pytest.raises(FileExistsError, match=r"car.photos holds something else than photos of an asset.*another name"):
        save(pictured, tmp_path / "car.usdc", overwrite=True)
    assert (folder / "beach.webp").read_bytes() == b"a holiday" and load(tmp_path / "car.usdc").photos == ()


def test_photos_stay_where_the_asset_cannot_be_written(pictured, tmp_path):
    save(pictured, tmp_path / "car.usdc")
    for photos in ((), (photo(10),)):
        with pytest.raises(ValueError, match="meta"):
            save(replace(pictured, photos=photos, meta={"odd": object()}), tmp_path / "car.usdc", overwrite=True)
    assert len(load(tmp_path / "car.usdc").photos) == 2 and len(list(tmp_path.iterdir())) == 2


def test_photos_go_along_into_the_databank_and_into_edits(pictured, street, tmp_path):
    bank = Databank(tmp_path / "bank")
    stored = bank.load(bank.add(pictured))
    assert len(stored.photos) == 2 and not validate(tmp_path / "bank")
    folder = tmp_path / "s1"
    save(street, folder)
    add_edit(folder, "new", [Actor(stored, street.actors[0].trajectory, "new_1")], {"kind": "insert"})
    add_change(folder, "other", load(folder), Edit(replace={"veh_1": stored}), {})
    scene = load(folder)
    assert {a.track: len(a.asset.photos) for a in scene.actors} == {"veh_1": 2, "new_1": 2}
    assert scene.actors[0].asset.photos[0].read().shape == (20, 32, 4)


def test_a_lens_that_is_no_pinhole_is_refused(tmp_path):
    bent = photo(lens=OpenCV(30.0, 30.0, 16.0, 10.0, k1=0.1))
    with pytest.raises(ValueError, match="pinhole"):
        save(replace(car(), photos=(bent,)), tmp_path / "car.usdc")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "change",
    [
        lambda told: told[0].update(file="../../secret.webp"),
        lambda told: told[0].update(asset_from_cam=[[1, 0], [0, 1]]),
        lambda told: told[0].update(pinhole=[0, 1, 2, 3]),
        lambda told: told[0].pop("time_us"),
        lambda told: told[0].update(width=0),
    ],
)
def test_a_corrupt_index_names_the_file_and_the_fix(pictured, tmp_path, change):
    save(pictured, tmp_path / "car.usdc")
    index = photos_folder(tmp_path / "car.usdc") / "photos.json"
    told = json.loads(index.read_text())
    change(told)
    index.write_text(json.dumps(told))
    with pytest.raises(ValueError, match=r"photos.json is corrupt.*loads without photos"):
        load_photos(tmp_path / "car.usdc")


def test_a_picture_that_is_not_what_the_index_says_is_refused(pictured, tmp_path):
    from PIL import Image

    save(pictured, tmp_path / "car.usdc")
    first, second = sorted(photos_folder(tmp_path / "car.usdc").glob("*.webp"))
    Image.new("RGBA", (640, 480)).save(first)
    second.write_bytes(b"no picture")
    found = load(tmp_path / "car.usdc").photos
    with pytest.raises(ValueError, match="640x480"):
        found[0].read()
    with pytest.raises(ValueError, match="does not decode"):
        found[1].read()


def test_a_databank_whose_photos_are_broken_is_told_of(pictured, tmp_path):
    bank = Databank(tmp_path / "bank")
    bank.add(pictured)
    next((tmp_path / "bank").rglob("01.webp")).write_bytes(b"no picture")
    (problem,) = validate(tmp_path / "bank")
    assert "car/0001" in problem and "01.webp" in problem
