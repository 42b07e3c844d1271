"""Photos that COLMAP gave a lens each share one."""

import re

import numpy as np
import pytest
import torch
from made_colmap import UNIT, relative

from recon import open_log

pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'sidestep[colmap]'")


def lens_each(folder, focals):
    """A text model of one lens, given lenses with these focal lengths in its place, which its pictures have by turns."""
    model = folder / "sparse/0"
    _, kind, width, height, _, _, cx, cy = (model / "cameras.txt").read_text().splitlines()[0].split()
    (model / "cameras.txt").write_text("".join(f"{k} {kind} {width} {height} {f} {f} {cx} {cy}\n" for k, f in enumerate(focals, 1)))
    lines = (model / "images.txt").read_text().splitlines()
    for k in range(len(lines) // 2):
        words = lines[2 * k].split()
        lines[2 * k] = " ".join([*words[:8], str(k % len(focals) + 1), words[9]])
    (model / "images.txt").write_text("\n".join(lines) + "\n")


def test_photos_that_have_a_lens_each_share_one(own, workspace):
    """As COLMAP's feature_extractor makes them by itself: one camera took them, and what it found of each picture is a little off."""
    as_one = open_log(workspace, metres_per_unit=1 / UNIT).camera("camera")
    lens_each(own, as_one.lens.fx * (1 + 0.01 * np.random.default_rng(0).standard_normal(12)))
    log = open_log(own, metres_per_unit=1 / UNIT)
    assert list(log.cameras) == ["camera"] and len(log.camera("camera").files) == 12
    camera = log.camera("camera")
    assert camera.lens.fx == pytest.approx(as_one.lens.fx, rel=2e-3)
    torch.testing.assert_close(relative(camera.world_from_cam)[:, :3, :3], relative(as_one.world_from_cam)[:, :3, :3], atol=2e-3, rtol=0)
    before, after = (sum(map(len, one.points.seen["camera"])) for one in (open_log(workspace), log))
    assert 0.95 * before < after <= before  # points that one picture shows are held by nothing


def test_photos_of_which_a_few_have_a_lens_each_are_no_rig(own):
    lens_each(own, [57.6] * 4)
    log = open_log(own, metres_per_unit=1.0)
    assert list(log.cameras) == ["camera"] and len(log.camera("camera")) == 12
    (own / "sparse/0/images.txt").write_text(re.sub(r"([1-4]) (\d+.png)", r"\1 c\1_\2", (own / "sparse/0/images.txt").read_text()))
    for file in (own / "images").iterdir():
        file.rename(file.with_name(f"c{int(file.stem) % 4 + 1}_{file.name}"))
    assert list(open_log(own, metres_per_unit=1.0).cameras) == ["c1", "c2", "c3", "c4"], "by their names they are one"


def test_lenses_that_are_alike_are_one_without_points_too(own):
    lens_each(own, [57.6] * 12)
    (own / "sparse/0/points3D.txt").write_text("")
    lines = (own / "sparse/0/images.txt").read_text().splitlines()
    (own / "sparse/0/images.txt").write_text("".join(f"{line}\n\n" for line in lines[::2]))
    assert list(open_log(own, metres_per_unit=1.0).cameras) == ["camera"]
    lens_each(own, [57.6] * 11 + [58.0])
    with pytest.raises(ValueError, match=r"no points by which they could share one.*single_camera_per_folder 1"):
        open_log(own, metres_per_unit=1.0)


def test_photos_through_several_lenses_are_refused(own):
    lens_each(own, [57.6, 115.2] * 6)
    images = own / "sparse/0/images.txt"
    lines = images.read_text().splitlines()
    for k in range(3, len(lines), 4):  # what every second one shows is twice as large
        seen = np.array(lines[k].split(), dtype=float).reshape(-1, 3)
        lines[k] = " ".join(f"{2 * u - 48} {2 * v - 27} {int(p)}" for u, v, p in seen)
    images.write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match=r"a lens for each picture or few, its points are .* pixels off.*zoomed"):
        open_log(own)
