import shutil
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from made_tape import STAMPS, STEP_US, check, tape

from recon import open_log
from recon.readers.ncore import lens_of
from scenes.lenses import Fisheye, FTheta, OpenCV, Pinhole
from scenes.poses import inverse

pytest.importorskip("ncore", reason="needs nvidia-ncore, which Python 3.14 cannot install: pip install 'sidestep[ncore]'")
import made_ncore  # noqa: E402
from made_ncore import EGO, NAMES, READOUT_US, write_ncore  # noqa: E402


@pytest.fixture(scope="module")
def recorded(street):
    return tape(street)


@pytest.fixture(scope="module")
def sequence(tmp_path_factory, recorded):
    return write_ncore(tmp_path_factory.mktemp("ncore") / "sequence", recorded)


def test_a_sequence_reads_as_it_was_recorded(sequence, recorded):
    log = open_log(sequence)
    check(log, recorded, NAMES)
    assert log.front == (NAMES["front"],) and len(log.tracks) == 2 and log.name == "ncore-made"
    shutters = {name: (c.shutter, c.readout_us) for name, c in log.cameras.items()}
    assert shutters == {NAMES["front"]: ("rows", READOUT_US), NAMES["right"]: ("rows", -READOUT_US)}
    assert open_log(sequence / "made.json").name == log.name
    assert all((s.read().times_us == s.time_us - STEP_US // 3).all() for s in log.sweeps), "not at their turn's end"


def test_every_lens_is_read_in_its_own_convention():
    plain = {"focal_length": [900.0, 905.0], "principal_point": [640.0, 360.0]}

    def model(kind: str, **more) -> SimpleNamespace:
        return SimpleNamespace(type=lambda: kind, **plain | more)

    assert lens_of(model("ideal-pinhole"), "x") == Pinhole(900.0, 905.0, 640.0, 360.0)
    fisheye = lens_of(model("opencv-fisheye", radial_coeffs=[0.1, 0.2, 0.3, 0.4]), "x")
    assert fisheye == Fisheye(900.0, 905.0, 640.0, 360.0, 0.1, 0.2, 0.3, 0.4)
    bent = {"radial_coeffs": [1.0, 2, 3, 4, 5, 6], "tangential_coeffs": [0.7, 0.8], "thin_prism_coeffs": [0.1, 0.2, 0.3, 0.4]}
    lens = lens_of(model("opencv-pinhole", **bent), "x")
    assert isinstance(lens, OpenCV) and (lens.k2, lens.p1, lens.k3, lens.k6, lens.s4) == (2, 0.7, 3, 6, 0.4)
    theta = {"angle_to_pixeldist_poly": np.array([0.0, 500, 1, 2, 3, 4]), "linear_cde": [1.01, 0.02, 0.03]}
    assert lens_of(model("ftheta", **theta), "x") == FTheta(640.5, 360.5, 500, 1, 2, 3, 4, 1.01, 0.02, 0.03)
    with pytest.raises(ValueError, match="front has the lens mirror; read are ftheta"):
        lens_of(model("mirror"), "front")


def test_the_recording_car_is_masked_where_the_sequence_says(sequence):
    front, right = (open_log(sequence).cameras[NAMES[side]] for side in ("front", "right"))
    np.testing.assert_array_equal(front.ego_mask, np.array(EGO))
    assert right.ego_mask is None


def test_a_sequence_need_not_have_masks_and_cuboids(tmp_path, recorded):
    log = open_log(write_ncore(tmp_path / "bare", recorded, annotated=False))
    assert not log.tracks and log.cameras[NAMES["front"]].ego_mask is None
    check(log, recorded, NAMES)


def test_a_cuboid_that_leans_stands_on_the_middle_of_its_base(tmp_path, recorded, monkeypatch):
    """Turned about x, then y, then z, as the package's own `transform_bbox` has it."""
    (cx, cy, cz), (sx, sy, sz) = np.cos([0.1, -0.2, 0.3]), np.sin([0.1, -0.2, 0.3])
    about_x, about_y = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]]), np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    turned, upright = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]]) @ about_y @ about_x, made_ncore.cuboid

    def leaning(*told):
        seen = upright(*told)
        return replace(seen, bbox3=replace(seen.bbox3, centroid=(9.0, 2.0, 1.0), rot=(0.1, -0.2, 0.3)))

    monkeypatch.setattr(made_ncore, "cuboid", leaning)
    log = open_log(write_ncore(tmp_path / "sequence", recorded))
    for track in log.tracks:
        local = (inverse(log.ego.at_each(torch.from_numpy(track.times_us))) @ track.world_from_box).numpy()
        np.testing.assert_allclose(local[:, :3, :3], np.broadcast_to(turned, (len(local), 3, 3)), atol=1e-6)
        np.testing.assert_allclose(local[:, :3, 3], [[9.0, 2.0, 1.0] - turned[:, 2] * track.size[2] / 2] * len(local), atol=1e-5)


def test_cameras_may_begin_before_the_lidar(tmp_path, recorded, monkeypatch):
    """And the body's path is known at their pictures, not at the lidar's turns alone."""
    monkeypatch.setattr(made_ncore, "LOST", slice(4))
    log = open_log(write_ncore(tmp_path / "sequence", recorded))
    assert len(log.sweeps) == 2
    for name, camera in log.cameras.items():
        assert len(camera) == len(STAMPS) and log.ego.covers_each(camera.times_us).all()
        offsets = log.offsets(name)
        torch.testing.assert_close(offsets, offsets[:1].expand(len(offsets), 4, 4), atol=1e-6, rtol=0)


def test_without_the_package_the_fix_is_named(sequence, monkeypatch):
    monkeypatch.setitem(sys.modules, "ncore.data.v4", None)
    with pytest.raises(ValueError, match="pip install nvidia-ncore"):
        open_log(sequence)


@pytest.mark.parametrize("broken", ["missing", "cut off", "elsewhere"])
def test_a_sequence_that_does_not_open_is_named(sequence, tmp_path, broken):
    copy = shutil.copytree(sequence, tmp_path / "copy")
    store = sorted(copy.glob("*.itar"))[0]
    if broken == "missing":
        store.unlink()
    elif broken == "cut off":
        store.write_bytes(store.read_bytes()[:1000])
    else:
        (copy / "made.json").write_text((copy / "made.json").read_text().replace(".zarr.itar", ".gone.itar"))
    with pytest.raises(ValueError, match="made.json does not open as an NCore sequence .+fetch its component stores again"):
        open_log(copy)


def test_other_json_files_are_no_sequence(tmp_path):
    (tmp_path / "notes.json").write_text('{"component_stores": 1}')
    with pytest.raises(ValueError, match="not a known layout"):
        open_log(tmp_path)
