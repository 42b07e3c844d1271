"""GLB files as other tools write them: stretched and mirrored nodes, sparse accessors, SPZ inside, drafts' names."""

import numpy as np
import pytest
import torch
from made_glb import NAME, rewritten
from randomized import gaussians

from scenes import load, save
from scenes.formats.spz import load_spz, save_spz
from scenes.harmonics import evaluate
from scenes.poses import matrix_from_quat

UP = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], dtype=torch.float64)


@pytest.fixture
def glb(tmp_path):
    save(gaussians(20, 16), tmp_path / "a.glb")
    rewritten(tmp_path / "a.glb", lambda tree: tree["nodes"][0].pop("rotation"))
    return tmp_path / "a.glb"


def body(path):
    data = path.read_bytes()
    return data[data.index(b"BIN\0") + 4 :]


def covariances(g):
    axes = matrix_from_quat(g.quats.double()) @ torch.diag_embed(g.log_scales.double().exp())
    return axes @ axes.transpose(1, 2)


@pytest.mark.parametrize("scale", [(1, 2, 0.5), (-1, 1, 1), (3, 3, -3), (0.001, 40, 1)])
def test_a_node_that_stretches_or_mirrors_takes_its_gaussians_along(glb, scale):
    before = gaussians(20, 16)
    turn = torch.tensor([0.1, -0.4, 0.3, 0.8], dtype=torch.float64)  # xyzw
    turn = turn / turn.norm()
    rewritten(glb, lambda tree: tree["nodes"][0].update(scale=scale, rotation=turn.tolist(), translation=[1, 2, 3]))
    g = load(glb)
    linear = UP @ matrix_from_quat(turn[[3, 0, 1, 2]]) @ torch.diag(torch.tensor(scale, dtype=torch.float64))
    wanted = linear @ covariances(before) @ linear.T
    assert ((covariances(g) - wanted).flatten(1).norm(dim=1) < 1e-4 * wanted.flatten(1).norm(dim=1)).all()
    assert g.means.numpy() == pytest.approx((before.means.double() @ linear.T + UP @ torch.tensor([1.0, 2, 3]).double()).numpy(), abs=1e-3)
    mirrored = UP @ matrix_from_quat(turn[[3, 0, 1, 2]]) @ torch.diag(torch.tensor(scale, dtype=torch.float64).sign())
    eye = torch.nn.functional.normalize(torch.randn(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64), dim=1)
    assert evaluate(g.sh.double(), eye @ mirrored.T).numpy() == pytest.approx(evaluate(before.sh.double(), eye).numpy(), abs=1e-4)


def test_a_sparse_accessor_changes_some_values_of_its_view_or_of_zeros(glb):
    g, whole = load(glb), body(glb)
    extra = np.array([2, 19], "<u2").tobytes() + np.array([0.25, 0.75], "<f4").tobytes()

    def make(tree):
        tree["bufferViews"] += [
            {"buffer": 0, "byteOffset": len(whole), "byteLength": 4},
            {"buffer": 0, "byteOffset": len(whole) + 4, "byteLength": 8},
        ]
        at = len(tree["bufferViews"])
        sparse = {"count": 2, "indices": {"bufferView": at - 2, "componentType": 5123}, "values": {"bufferView": at - 1}}
        attributes = tree["meshes"][0]["primitives"][0]["attributes"]
        tree["accessors"][attributes[f"{NAME}:OPACITY"]]["sparse"] = sparse
        del tree["accessors"][attributes[f"{NAME}:SH_DEGREE_3_COEF_6"]]["bufferView"]

    rewritten(glb, make, whole + extra)
    few = load(glb)
    wanted = g.logit_opacities.sigmoid()
    wanted[2], wanted[19] = 0.25, 0.75
    assert few.logit_opacities.sigmoid().numpy() == pytest.approx(wanted.numpy(), abs=1e-6)
    assert few.sh[:, :9].numpy() == pytest.approx(g.sh[:, :9].numpy()) and not torch.equal(few.sh[:, 9:], g.sh[:, 9:])


@pytest.mark.parametrize("place", ["KHR_gaussian_splatting_compression_spz_2", "KHR_gaussian_splatting_compression_spz", "draft"])
def test_spz_inside_is_unpacked(glb, tmp_path, place):
    save_spz(tmp_path / "a.spz", gaussians(20, 9), 2)
    inside = (tmp_path / "a.spz").read_bytes()

    def make(tree):
        tree["bufferViews"] = [{"buffer": 0, "byteOffset": 4, "byteLength": len(inside)}]
        primitive = tree["meshes"][0]["primitives"][0]
        primitive["attributes"] = {}
        if place == "draft":
            primitive["extensions"] = {"KHR_spz_gaussian_splats_compression": {"bufferView": 0}}
        else:
            primitive["extensions"] = {NAME: {"extensions": {place: {"bufferView": 0}}}}

    rewritten(glb, make, b"\0" * 4 + inside + b"\0" * (-len(inside) % 4))
    g, alone = load(glb), load_spz(tmp_path / "a.spz")
    assert g.means.numpy() == pytest.approx(alone.means.numpy(), abs=1e-5)  # both are y up
    assert torch.equal(g.logit_opacities, alone.logit_opacities) and g.sh_degree == 2


def test_drafts_had_colour_and_opacity_in_one_attribute(glb):
    g, whole = load(glb), body(glb)
    colours = np.concatenate([g.sh[:, 0] * 0.28209479177387814 + 0.5, g.logit_opacities.sigmoid()[:, None]], 1).astype("<f4")

    def make(tree):
        tree["bufferViews"].append({"buffer": 0, "byteOffset": len(whole), "byteLength": colours.nbytes})
        tree["accessors"].append({"bufferView": len(tree["bufferViews"]) - 1, "componentType": 5126, "count": 20, "type": "VEC4"})
        names = tree["meshes"][0]["primitives"][0]["attributes"]
        drafted = {"COLOR_0": len(tree["accessors"]) - 1, "POSITION": names["POSITION"]}
        drafted |= {
            name.replace(f"{NAME}:", "_"): i for name, i in names.items() if "ROTATION" in name or "SCALE" in name or "DEGREE_1" in name
        }
        tree["meshes"][0]["primitives"][0]["attributes"] = drafted

    rewritten(glb, make, whole + colours.tobytes())
    old = load(glb)
    assert old.sh.numpy() == pytest.approx(g.sh[:, :4].numpy(), abs=1e-5) and torch.equal(old.log_scales, g.log_scales)
    assert old.logit_opacities.sigmoid().numpy() == pytest.approx(g.logit_opacities.sigmoid().numpy(), abs=1e-5)


def test_a_scale_of_zero_is_a_flat_splat(glb):
    whole = bytearray(body(glb))
    tree = rewritten(glb, lambda tree: None)
    at = tree["bufferViews"][tree["meshes"][0]["primitives"][0]["attributes"][f"{NAME}:SCALE"]]["byteOffset"]
    whole[at + 8 : at + 12] = bytes(4)
    rewritten(glb, lambda tree: None, bytes(whole))
    assert 0 < float(load(glb).log_scales[0, 2].exp()) < 2e-6
