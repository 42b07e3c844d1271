"""GLB: a file of glTF's own axes, with nodes."""

import math

import numpy as np
import pytest
import torch
from made_glb import NAME, rewritten
from randomized import gaussians

from scenes import load, save
from scenes.harmonics import evaluate
from scenes.poses import matrix_from_quat


@pytest.fixture
def glb(tmp_path):
    save(gaussians(20, 16), tmp_path / "a.glb")
    return tmp_path / "a.glb"


def test_what_is_written_is_ratified_gltf(glb):
    tree = rewritten(glb, lambda tree: None)
    (primitive,) = tree["meshes"][0]["primitives"]
    assert tree["extensionsUsed"] == [NAME] and primitive["mode"] == 0
    assert primitive["extensions"][NAME]["kernel"] == "ellipse" and primitive["extensions"][NAME]["colorSpace"] == "srgb_rec709_display"
    assert len(primitive["attributes"]) == 4 + 16 and f"{NAME}:SH_DEGREE_3_COEF_6" in primitive["attributes"]
    data, g = glb.read_bytes(), gaussians(20, 16)
    start = data.index(b"BIN\0") + 4
    at = tree["bufferViews"][primitive["attributes"][f"{NAME}:SCALE"]]["byteOffset"]
    scales = np.frombuffer(data, "<f4", 60, start + at).reshape(20, 3)
    assert scales == pytest.approx(g.log_scales.exp().numpy(), rel=1e-6)  # linear, as the ratified text has it
    bounds = tree["accessors"][primitive["attributes"]["POSITION"]]
    assert bounds["min"] == g.means.amin(0).tolist() and bounds["max"] == g.means.amax(0).tolist()


def test_a_viewer_that_heeds_the_node_sees_z_up_as_y_up(glb):
    node = rewritten(glb, lambda tree: None)["nodes"][0]
    x, y, z, w = node["rotation"]
    turn = matrix_from_quat(torch.tensor([w, x, y, z], dtype=torch.float64))
    assert (turn @ torch.tensor([0.0, 0, 1], dtype=torch.float64)).tolist() == pytest.approx([0, 1, 0], abs=1e-12)


def test_a_file_of_gltfs_axes_is_turned_to_z_up_with_its_colours(glb):
    g = load(glb)
    rewritten(glb, lambda tree: tree["nodes"][0].pop("rotation"))
    up = load(glb)
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    assert up.means == pytest.approx(g.means @ turn.T, abs=1e-5)
    dice = torch.Generator().manual_seed(0)
    eye = torch.nn.functional.normalize(torch.randn(20, 3, generator=dice), dim=1)
    assert evaluate(up.sh, eye @ turn.T) == pytest.approx(evaluate(g.sh, eye), abs=1e-5)
    shapes = [matrix_from_quat(h.quats) @ torch.diag_embed(h.log_scales.exp()) for h in (g, up)]
    covariances = [s @ s.transpose(1, 2) for s in shapes]
    assert covariances[1] == pytest.approx(turn @ covariances[0] @ turn.T, rel=1e-4, abs=1e-4)


def test_nodes_move_scale_and_nest(glb):
    g = load(glb)
    half = math.sqrt(0.5)

    def nest(tree):
        inner = {"mesh": 0, "rotation": [-half, 0, 0, half]}
        tree["nodes"] = [{"children": [1, 2], "scale": [2, 2, 2]}, inner, {**inner, "translation": [1, 2, 3]}]

    rewritten(glb, nest)
    both = load(glb)
    order = both.means[:20, 0].sub(2 * g.means[:, 0]).abs().max() > 1e-4  # which of the two comes first is nobody's business
    still, moved = (both.select(torch.arange(20) + 20 * (order ^ which)) for which in (False, True))
    assert still.means == pytest.approx(2 * g.means, abs=1e-5) and still.log_scales == pytest.approx(g.log_scales + math.log(2), abs=1e-5)
    assert moved.means == pytest.approx(2 * g.means + torch.tensor([2.0, -6.0, 4.0]), abs=1e-4)  # y up (1, 2, 3) is z up (1, -3, 2)


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda t: t["nodes"][0].update(scale=[1, 0, 1]), "whose scale is 0"),
        (lambda t: t["nodes"][0].update(children=[0]), "stands in its tree twice"),
        (lambda t: t["meshes"][0]["primitives"][0].pop("extensions"), "is a mesh, not splats"),
        (lambda t: t["meshes"][0]["primitives"][0]["attributes"].pop(f"{NAME}:SCALE"), f"without {NAME}:SCALE"),
        (lambda t: t["meshes"][0]["primitives"][0]["attributes"].pop(f"{NAME}:SH_DEGREE_2_COEF_1"), "SH_DEGREE_2_COEF_1"),
        (lambda t: t["meshes"][0]["primitives"][0]["extensions"][NAME].update(extensions={f"{NAME}_compression_spz_2": {}}), "bufferView"),
        (lambda t: t["meshes"][0]["primitives"][0]["extensions"][NAME].update(extensions={f"{NAME}_compression_x": {}}), "packed by"),
        (lambda t: t["meshes"][0]["primitives"][0]["extensions"][NAME].update(colorSpace="lin_rec709_display"), "srgb_rec709_display"),
        (lambda t: t["meshes"][0]["primitives"][0]["extensions"][NAME].update(kernel="cone"), "kernel is 'cone'"),
        (lambda t: t["accessors"][0].update(count=2**60), "accessor 0 claims 1152921504606846976"),
        (lambda t: t["accessors"][0].update(sparse={}), "does not hold what glTF 2.0 says"),
        (lambda t: (t["accessors"][0].pop("bufferView"), t["accessors"][0].update(count=2**40)), "accessor 0 claims 1099511627776"),
        (lambda t: t["bufferViews"][1].update(byteOffset=10**9), "truncated or corrupt: buffer view 1"),
        (lambda t: t["accessors"][3].update(count=19), "its attributes have 19, 20 values"),
        (lambda t: t.update(scene=-1), "does not hold what glTF 2.0 says"),
        (lambda t: t.update(nodes=7), "does not hold what glTF 2.0 says"),
    ],
)
def test_a_foreign_or_corrupt_tree_is_refused(glb, change, said):
    rewritten(glb, change)
    with pytest.raises(ValueError, match=said) as error:
        load(glb)
    assert str(glb) in str(error.value)


def test_whole_numbers_and_interleaved_attributes_are_read(glb):
    """ROTATION as normalized shorts in one view with POSITION, 20 bytes a splat."""
    g = load(glb)
    body = glb.read_bytes()
    body = body[body.index(b"BIN\0") + 4 :]
    records = np.zeros(20, [("at", "<f4", 3), ("turn", "<i2", 4)])
    records["at"] = g.means
    records["turn"] = np.rint(g.quats.numpy()[:, [1, 2, 3, 0]] * 32767)

    def weave(tree):
        names = tree["meshes"][0]["primitives"][0]["attributes"]
        tree["bufferViews"].append({"buffer": 0, "byteOffset": len(body), "byteLength": 400, "byteStride": 20})
        view = {"bufferView": len(tree["bufferViews"]) - 1, "count": 20}
        tree["accessors"][names["POSITION"]] = {**view, "componentType": 5126, "type": "VEC3"}
        tree["accessors"][names[f"{NAME}:ROTATION"]] = {
            **view, "byteOffset": 12, "componentType": 5122, "type": "VEC4", "normalized": True,
        }  # fmt: skip

    rewritten(glb, weave, body + records.tobytes())
    woven = load(glb)
    assert torch.equal(woven.means, g.means) and woven.quats == pytest.approx(g.quats, abs=1e-4)


def test_a_mesh_is_called_one(shared):
    with pytest.raises(ValueError, match="stop_sign.glb is a mesh, not splats"):
        load(shared / "meshes" / "stop_sign.glb")
