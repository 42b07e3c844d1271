"""The examples and the demo run, on a small scene."""

import importlib.util
import json
from pathlib import Path

import pytest
import street as made
from made_colmap import pictures_along, write_colmap

from enhance.network.net import Net
from enhance.network.weights_file import save_net
from render.video import read_image, read_video
from scenes import Databank, save

EXAMPLES = Path(__file__).parents[1] / "examples"
SMALL = {"width": 64, "height": 48}


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    """A folder like examples/data, of a made-up street, and the weights of an untrained network, which changes nothing."""
    folder = tmp_path_factory.mktemp("data")
    save(made.street(), folder / "drive002")
    for _ in range(2):
        Databank(folder / "databank").add(made.car())
    save_net(Net(), folder / "weights.safetensors", {})
    return folder


def example(number: str):
    (path,) = EXAMPLES.glob(f"{number}_*.py")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_examples_are_short_and_numbered():
    for i, path in enumerate(sorted(EXAMPLES.glob("*.py")), 1):
        assert path.name.startswith(f"{i:02d}_")
        assert 20 <= len(path.read_text().splitlines()) <= 90


def test_splats_are_rendered(tmp_path, capsys):
    example("01").main(tmp_path / "ring.png")
    picture = read_image(tmp_path / "ring.png")
    assert picture.shape == (360, 640, 3)
    assert picture.std() > 0.1
    assert "depth" in capsys.readouterr().out


def test_a_drive_is_shifted(data, tmp_path):
    example("02").main(data / "drive002", width=64, output=tmp_path / "shifted.png")
    assert read_image(tmp_path / "shifted.png").std() > 0.1


def test_assets_are_inserted(data, tmp_path):
    example("03").main(data / "drive002", data / "databank", 2, **SMALL, output=tmp_path / "inserted.mp4")
    assert len(list(read_video(tmp_path / "inserted.mp4"))) == 2


def test_a_clip_is_enhanced(data, tmp_path):
    weights = str(data / "weights.safetensors")
    example("04").main(data / "drive002", data / "databank", weights, 2, **SMALL, output=tmp_path / "enhanced.mp4")
    assert len(list(read_video(tmp_path / "enhanced.mp4"))) == 2


def test_a_drive_of_ones_own_is_reconstructed_and_shifted(tmp_path, capsys):
    pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")
    workspace = write_colmap(tmp_path / "walk", made.street(), {"": pictures_along(made.street(), count=6)})
    example("05").main(workspace, tmp_path / "scene", camera_height=1.5, steps=20)
    assert "camera: 6 pictures of 96x54, pinhole lens" in capsys.readouterr().out
    assert read_image(tmp_path / "scene.png").shape[1] > 3 * 96


def test_an_own_asset_is_put_on_the_street(data, tmp_path, capsys):
    out = tmp_path / "own.png"
    example("06").main(scene=data / "drive002", databank=tmp_path / "bank", splats=800, steps=20, width=64, output=out)
    assert read_image(out).std() > 0.1
    told = capsys.readouterr().out
    assert "cone/0001: 0.50 m long, 0.50 m wide, 0.90 m high" in told and "light: the sky's image" in told


def test_the_demo_makes_a_clip_a_report_and_a_contact_sheet(data, tmp_path, monkeypatch):
    from enhance import demo

    monkeypatch.setattr(demo, "WIDTH", 64)
    monkeypatch.setattr(demo, "HEIGHT", 48)
    monkeypatch.setattr(demo, "MOVING", "car/0002@8m,0m,speed=4m/s")
    demo.demonstrate(data, tmp_path, str(data / "weights.safetensors"))
    assert len(list(read_video(tmp_path / "out.mp4"))) == 8
    told = json.loads((tmp_path / "out.json").read_text())
    assert told["lateral_shift_m"] == 2 and len(told["inserted"]) == 2
    assert {"render", "enhance", "write"} <= set(told["ms_per_frame"])
    assert read_image(tmp_path / "contact.png").shape[1] > 4 * 64


def test_a_demo_that_fails_leaves_no_folder_and_spoils_none(data, tmp_path, monkeypatch):
    from enhance import demo

    def failing(_, folder):
        (folder / "out.json").write_text("{}")
        raise ValueError("no light")

    monkeypatch.setattr(demo, "DATA", data)
    monkeypatch.setattr(demo, "demonstrate", failing)
    with pytest.raises(ValueError, match="no light"):
        demo.Demo(tmp_path / "demo").run()
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(FileNotFoundError, match="the folder .*nowhere does not exist; create it first"):
        demo.Demo(tmp_path / "nowhere" / "demo").run()
    (tmp_path / "file").write_text("mine")
    with pytest.raises(FileExistsError, match="file is a file, and the demo makes a folder"):
        demo.Demo(tmp_path / "file").run()
    (tmp_path / "there").mkdir()
    (tmp_path / "there" / "out.mp4").write_text("mine")
    with pytest.raises(FileExistsError, match="out.mp4 exists; give -w to replace it"):
        demo.Demo(tmp_path / "there").run()
    assert (tmp_path / "there" / "out.mp4").read_text() == "mine"
    monkeypatch.setattr(demo, "demonstrate", lambda _, folder: [(folder / n).touch() for n in ("out.mp4", "out.json", "contact.png")])
    demo.Demo(tmp_path / "demo").run()
    assert sorted(p.name for p in (tmp_path / "demo").iterdir()) == ["contact.png", "out.json", "out.mp4"]


def test_the_bundled_street_has_what_the_demo_needs():
    from enhance.demo import CAMERA, MOVING, PARKED
    from scenes import load
    from scenes.placement import parse_placement
    from scenes.report import validate

    data = EXAMPLES / "data"
    scene = load(data / "drive002")
    assert len(scene.frame_times(CAMERA)) >= 60
    ids = {e.id for e in Databank(data / "databank").entries()}
    assert len(ids) >= 3
    assert {parse_placement(text).asset for text in (PARKED, MOVING)} <= ids
    assert "CC BY 4.0" in scene.meta["licence"]
    assert validate(data / "databank") == []
    shipped = [p for folder in (data, EXAMPLES.parent / "enhance" / "weights") for p in folder.rglob("*") if p.is_file()]
    assert sum(p.stat().st_size for p in shipped) <= 20_000_000, "all scenes and weights that the project ships"
