"""What structure from motion is asked, and which of its answers is taken."""

import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from PIL import Image

from recon.sfm import solve as sfm
from recon.sfm.colmap import pycolmap
from recon.sfm.together import together

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")


def test_who_is_told_to_stop_is_not_shown_where_colmap_was():
    """It comes with a handler of its own, which writes a crash report and ends the process before anything is tidied up."""
    stopped = "signal.signal(signal.SIGTERM, lambda *_: sys.exit(143)); pycolmap(); os.kill(os.getpid(), signal.SIGTERM); time.sleep(9)"
    program = f"import os, signal, sys, time; from recon.sfm.colmap import pycolmap; {stopped}"
    run = subprocess.run([sys.executable, "-c", program], stderr=subprocess.PIPE, text=True, timeout=120)
    assert run.returncode == 143 and not run.stderr


def test_a_known_angle_is_that_across_also_of_pictures_that_stand(tmp_path, monkeypatch):
    Image.fromarray(np.zeros((60, 40, 3), np.uint8)).save(tmp_path / "a.png")
    asked = []
    monkeypatch.setattr(sfm, "extract_features", lambda *given: asked.append(given[4].camera_params))
    monkeypatch.setattr(sfm, "_match_neighbours", lambda *_: None)
    monkeypatch.setattr(sfm, "together", lambda *_: [{"a.png"}])
    monkeypatch.setattr(sfm, "_largest", lambda *_: (None, 0))
    monkeypatch.setattr(sfm, "_fix_lens", lambda *_: 1.0)
    with pytest.raises(ValueError, match="only 0 of 1 pictures"):
        sfm.solve(tmp_path, ["a.png"], tmp_path, True, math.radians(90), "a")
    (focal, *rest) = map(float, asked[0].split(","))
    assert focal == pytest.approx(20) and rest == [20, 30, 0]


def test_a_lens_that_is_found_is_no_wider_than_any():
    options = sfm._solving_options(pycolmap(), None, 4.0)
    assert options.min_focal_length_ratio == pytest.approx(0.3004, abs=1e-4) and options.ba_refine_focal_length  # 0.5 / tan(59 deg)
    assert not sfm._solving_options(pycolmap(), 1.0, 4.0).ba_refine_focal_length


FREE, HELD, STEEP, FLAT = True, False, 4, 2


@pytest.mark.parametrize(
    ("size", "models", "tried", "taken"),
    [
        ((480, 270), [(5, 0.9)], [(FREE, STEEP)], 0),
        ((270, 480), [(2, 0.9), (5, 0.9)], [(FREE, STEEP), (FREE, FLAT)], 1),
        ((480, 270), [(5, 0.3), (5, 0.3), (4, 0.9), (5, 0.9)], [(FREE, STEEP), (FREE, FLAT), (HELD, STEEP), (HELD, FLAT)], 3),
        ((480, 270), [(3, 0.9), (5, 0.3), (5, 0.3), (5, 0.4)], [(FREE, STEEP), (FREE, FLAT), (HELD, STEEP), (HELD, FLAT)], 0),
        ((480, 270), [(5, 0.1), (5, 0.3), (4, 0.3), (5, 0.2)], [(FREE, STEEP), (FREE, FLAT), (HELD, STEEP), (HELD, FLAT)], 1),
        ((960, 540), [(4, 0.9), (5, 0.9)], [(FREE, STEEP), (HELD, STEEP)], 1),
    ],
)
def test_what_most_pictures_agree_with_is_taken_of_all_that_is_tried(size, models, tried, taken, tmp_path, monkeypatch):
    """Until four fifths are placed so: that a model has the pictures does not make it right."""
    Image.new("RGB", size).save(tmp_path / "0.png")
    (tmp_path / "database.db").touch()
    made = [SimpleNamespace(agrees=agrees, placed=placed, images={}, write=lambda _: None) for placed, agrees in models]
    asked = []

    def largest(_, __, ___, ____, options, _____):
        asked.append((options.ba_refine_focal_length, options.mapper.init_min_tri_angle))
        return (model := made[len(asked) - 1]), model.placed

    def fix_lens(_, __, options):
        options.ba_refine_focal_length = False
        return 1.0

    for name in ("extract_features", "_match_neighbours"):
        monkeypatch.setattr(sfm, name, lambda *_: None)
    monkeypatch.setattr(sfm, "_largest", largest)
    monkeypatch.setattr(sfm, "_fix_lens", fix_lens)
    monkeypatch.setattr(sfm, "_with_distortion", lambda _, model: model)
    monkeypatch.setattr(sfm, "agreement", lambda _, __, model, ___: model.agrees)
    monkeypatch.setattr(sfm, "together", lambda *_: [{f"{i}.png" for i in range(5)}])
    found = sfm.solve(tmp_path, ["0.png"] * 5, tmp_path, True, None, "a")
    assert found.model is made[taken] and asked == tried and (found.right > 0) == (models[taken][1] > 0.5)


@pytest.mark.parametrize(("size", "within"), [((480, 270), 2), ((270, 480), 2), ((960, 540), 4), ((1920, 1080), 4)])
def test_matches_of_small_pictures_are_off_by_as_little_of_them(size, within, tmp_path, monkeypatch):
    Image.new("RGB", size).save(tmp_path / "0.png")
    errors = []
    monkeypatch.setattr(sfm, "extract_features", lambda *_: None)
    monkeypatch.setattr(sfm, "_match_neighbours", lambda *given: errors.append(given[3].ransac.max_error))
    monkeypatch.setattr(sfm, "together", lambda *_: [{f"{i}.png" for i in range(5)}])
    monkeypatch.setattr(sfm, "_largest", lambda *given: errors.append(given[4].mapper.init_max_error) or (None, 0))
    monkeypatch.setattr(sfm, "_fix_lens", lambda *_: 1.0)
    with pytest.raises(ValueError, match="only 0 of 5"):
        sfm.solve(tmp_path, ["0.png"] * 5, tmp_path, True, 1.0, "a")
    assert errors == ([2, 2, 1, 2, 1] if within == 2 else [4, 4, 4])


@pytest.mark.parametrize(("size", "degrees"), [((800, 600), 60), ((600, 800), 46.83)])
def test_a_usual_lens_is_that_wide_along_the_longer_side(size, degrees, tmp_path):
    colmap, database = pycolmap(), tmp_path / "database.db"
    with colmap.Database.open(database) as opened:
        opened.write_camera(colmap.Camera(model="SIMPLE_RADIAL", width=size[0], height=size[1], params=[500, *size, 0.1]))
    assert math.degrees(sfm._fix_lens(colmap, database, sfm._solving_options(colmap, None, 4.0))) == pytest.approx(degrees, abs=0.01)
    with colmap.Database.open(database) as opened:
        (camera,) = opened.read_all_cameras()
    assert camera.has_prior_focal_length
    assert camera.params.tolist() == pytest.approx([400 / math.tan(math.radians(30)), size[0] / 2, size[1] / 2, 0])


def test_the_largest_of_several_models_whose_lens_is_one_is_taken(tmp_path):
    """Of two that are larger, one is wider than any, and one bends a thousandfold."""
    lenses = [pycolmap().Camera(model="SIMPLE_RADIAL", width=270, height=480, params=[f, 135, 240, k]) for f, k in
              ((200, 0.0), (200, -0.3), (140, 0.0), (200, 1284.8))]  # fmt: skip
    small, large, wide, bent = (
        SimpleNamespace(num_reg_images=lambda n=n: n, cameras={1: lens}) for n, lens in zip((3, 7, 9, 8), lenses, strict=True)
    )
    options = sfm._solving_options(pycolmap(), None, 4.0)
    told = []

    def mapping(*_, initial_image_pair_callback, next_image_callback):
        initial_image_pair_callback()
        next_image_callback()
        return {0: small, 1: large, 2: wide, 3: bent}

    found = sfm._largest(SimpleNamespace(incremental_mapping=mapping), tmp_path, tmp_path, tmp_path / "made", options, told.append)
    assert found == (large, 7) and told == [2, 3] and not (tmp_path / "made").exists()
    none = SimpleNamespace(incremental_mapping=lambda *_, **__: {})
    assert sfm._largest(none, tmp_path, tmp_path, tmp_path / "made", None, told.append) == (None, 0)


def test_pictures_after_a_cut_are_not_asked_for_and_told(tmp_path, monkeypatch):
    """No lens places what shares nothing with the rest: nothing else is tried where the longer shot is placed."""
    Image.new("RGB", (480, 270)).save(tmp_path / "0.png")
    (tmp_path / "database.db").touch()
    shots = [{"0.png", "1.png", "2.png"}, {"3.png", "4.png"}]
    placed = {i: SimpleNamespace(name=f"{i}.png", has_pose=True) for i in range(3)}
    tried = []
    for name in ("extract_features", "_match_neighbours"):
        monkeypatch.setattr(sfm, name, lambda *_: None)
    model = SimpleNamespace(images=placed, write=lambda _: None)
    monkeypatch.setattr(sfm, "together", lambda *_: shots)
    monkeypatch.setattr(sfm, "_largest", lambda *_: tried.append(1) or (model, 3))
    monkeypatch.setattr(sfm, "agreement", lambda *_: 0.9)
    found = sfm.solve(tmp_path, ["0.png"] * 5, tmp_path, True, None, "a")
    assert len(tried) == 1 and found.placed == 3 and found.elsewhere == {"3.png", "4.png"}


def test_pictures_are_together_that_matches_link_one_by_one_but_not_by_a_logo(tmp_path):
    colmap = pycolmap()
    kind = colmap.TwoViewGeometryConfiguration
    matches = np.stack([np.arange(20, dtype=np.uint32)] * 2, 1)
    with colmap.Database.open(tmp_path / "database.db") as opened:
        camera = opened.write_camera(colmap.Camera(model="SIMPLE_RADIAL", width=100, height=50, params=[80, 50, 25, 0]))
        ids = [opened.write_image(colmap.Image(name=name, camera_id=camera)) for name in "abcde"]
        for a, b, config in ((0, 1, kind.CALIBRATED), (1, 2, kind.UNCALIBRATED), (2, 3, kind.WATERMARK), (3, 4, kind.PLANAR), (0, 4, None)):
            geometry = colmap.TwoViewGeometry()
            if config is not None:
                geometry.config, geometry.inlier_matches = config, matches
            opened.write_two_view_geometry(ids[a], ids[b], geometry)
    assert together(colmap, tmp_path / "database.db") == [{"a", "b", "c"}, {"d", "e"}]
