"""SOG bundles as other tools write them: of a folder, and of version 1."""

import json
import zipfile

import numpy as np
import pytest
from PIL import Image
from randomized import gaussians

from scenes import load, save


@pytest.mark.parametrize("folder", ["scene/", "./", "a/b/"])
def test_a_bundle_of_a_folder_is_read(tmp_path, folder):
    save(gaussians(50, 4), tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as plain, zipfile.ZipFile(tmp_path / "b.sog", "w") as nested:
        nested.writestr("__MACOSX/meta.json", b"Finder's")
        for name in plain.namelist():
            nested.writestr(folder + name, plain.read(name))
    pairs = zip(load(tmp_path / "a.sog").tensors().values(), load(tmp_path / "b.sog").tensors().values(), strict=True)
    assert all((a == b).all() for a, b in pairs)


def test_version_1_runs_evenly_from_least_to_most_in_each_channel(tmp_path):
    """Six splats of degree 2, written by hand."""
    dice = np.random.default_rng(0)
    pixels = {
        name: dice.integers(0, 256, (8, 4)).astype(np.uint8) for name in ("means_l", "means_u", "quats", "scales", "sh0", "shN_labels")
    }
    pixels["quats"][:, 3] = 252
    pixels["quats"][:, :3] = 128 + pixels["quats"][:, :3] // 8
    pixels["shN_labels"][:, 0] %= 128
    pixels["shN_labels"][:, 1] = 0
    centroids = dice.integers(0, 256, (2, 64 * 8, 4)).astype(np.uint8)
    for name, values in [*((n, p.reshape(2, 4, 4)) for n, p in pixels.items()), ("shN_centroids", centroids)]:
        Image.fromarray(values).save(tmp_path / f"{name}.webp", "WEBP", lossless=True, exact=True)
    files = {"means": ["means_l.webp", "means_u.webp"], "shN": ["shN_centroids.webp", "shN_labels.webp"]}
    meta = {
        "means": {"shape": [6, 3], "mins": [-1, -2, 0], "maxs": [1, 3, 2], "files": files["means"]},
        "scales": {"mins": [-9, -8, -7], "maxs": [1, 0, -1], "files": ["scales.webp"]},
        "quats": {"encoding": "quaternion_packed", "files": ["quats.webp"]},
        "sh0": {"mins": [-1, -2, -3, -6], "maxs": [1, 2, 3, 9], "files": ["sh0.webp"]},
        "shN": {"mins": -0.5, "maxs": 0.25, "files": files["shN"]},
    }
    (tmp_path / "meta.json").write_text(json.dumps(meta))
    g = load(tmp_path)
    assert len(g) == 6 and g.sh_degree == 2
    for i in range(6):
        scales, colours = pixels["scales"][i] / 255, pixels["sh0"][i] / 255
        assert g.log_scales[i].tolist() == pytest.approx([-9 + 10 * scales[0], -8 + 8 * scales[1], -7 + 6 * scales[2]], abs=1e-5)
        assert g.sh[i, 0].tolist() == pytest.approx([-1 + 2 * colours[0], -2 + 4 * colours[1], -3 + 6 * colours[2]], abs=1e-5)
        assert float(g.logit_opacities[i]) == pytest.approx(-6 + 15 * colours[3], abs=1e-5)
        label = int(pixels["shN_labels"][i, 0])
        texels = centroids[label // 64, label % 64 * 8 : label % 64 * 8 + 8, :3]
        assert g.sh[i, 1:].numpy() == pytest.approx(-0.5 + 0.75 * texels / 255, abs=1e-6)
        place = (pixels["means_l"][i, :3] + 256.0 * pixels["means_u"][i, :3]) / 65535
        logs = np.array([-1, -2, 0]) + np.array([2, 5, 2]) * place
        assert g.means[i].tolist() == pytest.approx(np.sign(logs) * np.expm1(np.abs(logs)), abs=1e-5)
