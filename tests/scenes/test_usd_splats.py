import errno
import json
import os
import random
import resource
import subprocess
import sys

import numpy as np
import pytest
import torch
from pxr import Gf, Usd, UsdGeom, UsdVol, Vt
from randomized import asset, gaussians

from scenes import Gaussians, load, load_dropping, save
from scenes.harmonics import evaluate
from scenes.poses import matrix_from_quat
from scenes.usd.layers import usd_problems, valid_names
from scenes.usd.splats import stage_axes

SUFFIXES = ["usdc", "usda", "usd"]


def ulps(a, b):
    """Distance in float32 steps, elementwise, of positive or equal-signed numbers."""
    a, b = (np.asarray(v, np.float32).view(np.int32).astype(np.int64) for v in (a, b))
    return np.abs(a - b).max(initial=0)


def activated(g: Gaussians):
    """Scales, opacities and unit quaternions, computed in float64 and rounded once."""
    quats = g.quats.double() / g.quats.double().norm(dim=1, keepdim=True)
    opacities = g.logit_opacities.double().clamp(-15, 15).sigmoid()
    return [t.numpy().astype(np.float32) for t in (g.log_scales.double().exp(), opacities, quats)]


@pytest.mark.parametrize("coefficients", [1, 4, 9, 16])
@pytest.mark.parametrize("suffix", SUFFIXES)
def test_splats_return_within_one_ulp_of_the_activated_values(tmp_path, coefficients, suffix):
    before = gaussians(200, coefficients)
    save(before, tmp_path / f"a.{suffix}")
    after = load(tmp_path / f"a.{suffix}")
    assert torch.equal(after.means, before.means) and torch.equal(after.sh, before.sh)
    for a, b in zip(activated(before), activated(after), strict=True):
        assert ulps(a, b) <= 1
    assert after.logit_opacities.abs().max() <= 15


def test_the_file_holds_linear_scale_and_opacity_and_unit_quaternions(tmp_path):
    before = gaussians(50)
    save(before, tmp_path / "a.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    splats = UsdVol.ParticleField3DGaussianSplat(stage.GetPrimAtPath("/Splats/Gaussians"))
    scales, opacities, quats = activated(before)
    assert ulps(splats.GetScalesAttr().Get(), scales) <= 1
    assert ulps(splats.GetOpacitiesAttr().Get(), opacities) <= 1
    first = splats.GetOrientationsAttr().Get()[0]
    assert [first.real, *first.imaginary] == pytest.approx(quats[0].tolist())
    assert splats.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 1
    sh = np.array(splats.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    assert np.array_equal(sh.reshape(50, 4, 3), before.sh.numpy())


def test_the_extent_holds_every_splat_to_three_sigma(tmp_path):
    g = gaussians(60)
    save(g, tmp_path / "a.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "a.usdc"))
    low, high = np.array(UsdGeom.Boundable(stage.GetPrimAtPath("/Splats/Gaussians")).GetExtentAttr().Get())
    axes = matrix_from_quat(g.quats.double()) * g.log_scales.double().exp()[:, None]
    reach = 3 * axes.norm(dim=2)
    np.testing.assert_allclose(low, (g.means - reach).amin(0), rtol=1e-5)
    np.testing.assert_allclose(high, (g.means + reach).amax(0), rtol=1e-5)


def test_half_files_keep_float_positions_and_three_digits_of_the_rest(tmp_path):
    before = gaussians(300)
    save(before, tmp_path / "a.usdc", half=True)
    save(before, tmp_path / "b.usdc")
    after = load(tmp_path / "a.usdc")
    assert torch.equal(after.means, before.means)
    scales = before.log_scales.exp().clamp(2**-14, 65504)
    assert torch.allclose(after.log_scales.exp(), scales, rtol=1e-3)
    assert torch.allclose(after.logit_opacities.sigmoid(), before.logit_opacities.sigmoid(), atol=1e-3)
    assert torch.allclose(after.sh, before.sh, rtol=1e-3, atol=1e-6)
    turn = matrix_from_quat(after.quats.double()) - matrix_from_quat(before.quats.double())
    assert turn.abs().max() < 4e-3
    assert usd_problems(tmp_path / "a.usdc") == []


def test_half_files_take_28_bytes_a_splat_and_6_a_coefficient(tmp_path):
    for coefficients in (1, 4):
        sizes = []
        for count in (1000, 3000):
            save(gaussians(count, coefficients), tmp_path / f"{count}.usdc", overwrite=True, half=True)
            sizes.append((tmp_path / f"{count}.usdc").stat().st_size)
        assert (sizes[1] - sizes[0]) / 2000 == pytest.approx(28 + 6 * coefficients, abs=0.1)


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("count", [0, 1])
def test_few_splats_or_none_return(tmp_path, count, half):
    save(gaussians(count, 9), tmp_path / "a.usdc", half=half)
    after = load(tmp_path / "a.usdc")
    assert len(after) == count and after.sh_degree == 2
    assert usd_problems(tmp_path / "a.usdc") == []


@pytest.mark.parametrize("half", [False, True])
def test_extreme_splats_return_valid(tmp_path, half):
    g = gaussians(4)
    g.log_scales[0], g.log_scales[1] = -200.0, 80.0
    g.logit_opacities[:2] = torch.tensor([-1e4, 1e4])
    g.quats[0], g.quats[1] = torch.tensor([0.0, 1e-42, 0.0, 0.0]), torch.tensor([1e38, 1e38, 1e38, 1e38])
    save(g, tmp_path / "a.usdc", half=half)
    after = load(tmp_path / "a.usdc")
    assert after.logit_opacities[:2].tolist() == [-15, 15]
    assert after.quats[:2].flatten().tolist() == pytest.approx([0, 1, 0, 0, 0.5, 0.5, 0.5, 0.5], abs=1e-3)


def test_an_asset_returns_with_size_label_model_and_meta(tmp_path):
    before = asset()
    save(before, tmp_path / "a.usdc")
    after = load(tmp_path / "a.usdc")
    assert torch.equal(after.size, before.size)
    assert (after.label, after.model, after.meta) == (before.label, before.model, before.meta)
    assert torch.equal(after.gaussians.means, before.gaussians.means)


def test_usds_own_validators_find_nothing(tmp_path):
    for suffix in SUFFIXES:
        save(asset(), tmp_path / f"a.{suffix}")
        save(gaussians(), tmp_path / f"g.{suffix}")
        assert usd_problems(tmp_path / f"a.{suffix}") == [] and usd_problems(tmp_path / f"g.{suffix}") == []


def test_meta_that_is_not_json_is_refused_and_leaves_no_file(tmp_path):
    for value in (float("nan"), object()):
        bad = asset()
        bad.meta["bad"] = value
        with pytest.raises(ValueError, match="the asset's meta cannot be stored as JSON"):
            save(bad, tmp_path / "a.usdc")
    assert not list(tmp_path.iterdir())


def foreign(path, edit=None, type_name="ParticleField3DGaussianSplat"):
    """A splat file as another tool might write it; `edit(splats)` spoils it."""
    stage = Usd.Stage.CreateNew(str(path))
    splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Root/cloud")
    splats.CreatePositionsAttr(Vt.Vec3fArray(2, Gf.Vec3f(1, 2, 3)))
    splats.CreateOrientationshAttr(Vt.QuathArray(2, Gf.Quath(1)))
    splats.CreateScalesAttr(Vt.Vec3fArray(2, Gf.Vec3f(0.1)))
    splats.CreateOpacitiesAttr(Vt.FloatArray([0.5, 0.25]))
    splats.CreateRadianceSphericalHarmonicsDegreeAttr(0)
    splats.CreateRadianceSphericalHarmonicsCoefficientshAttr(Vt.Vec3hArray(2, Gf.Vec3h(1)))
    splats.GetPrim().SetTypeName(type_name)
    if edit:
        edit(splats)
    stage.GetRootLayer().Save()
    return path


def test_another_tools_file_with_some_half_attributes_loads(tmp_path):
    g = load(foreign(tmp_path / "a.usda"))
    assert g.means.tolist() == [[1, 2, 3]] * 2 and g.quats.tolist() == [[1, 0, 0, 0]] * 2
    assert g.logit_opacities.sigmoid().tolist() == pytest.approx([0.5, 0.25])


@pytest.mark.parametrize(
    "edit, said",
    [
        (lambda s: s.GetScalesAttr().Set(Vt.Vec3fArray(3)), "has 3 scales for 2 positions"),
        (lambda s: s.GetRadianceSphericalHarmonicsDegreeAttr().Set(1), "it needs 8"),
        (lambda s: s.GetRadianceSphericalHarmonicsDegreeAttr().Set(4), "degree 4"),
        (lambda s: s.GetPrim().RemoveProperty("opacities"), "has no opacities"),
        (lambda s: s.GetOpacitiesAttr().Set(Vt.FloatArray([0.5, 1.5])), "splat 1 has nan in logit_opacities"),
        (lambda s: s.GetScalesAttr().Set(Vt.Vec3fArray([Gf.Vec3f(1), Gf.Vec3f(-1, 1, 1)])), "splat 1 has nan in log_scales"),
        (lambda s: s.AddScaleOp().Set(Gf.Vec3f(1, 0, 1)), "whose scale is 0"),
        (lambda s: s.GetPrim().SetTypeName("Points"), "must hold one ParticleField3DGaussianSplat, it has none"),
    ],
)
def test_another_tools_bad_file_is_refused(tmp_path, edit, said):
    with pytest.raises(ValueError, match=said):
        load(foreign(tmp_path / "a.usda", edit))


def saying(path, up=None, metres=None):
    """The file with its stage's axis and unit as given, or not said at all."""
    stage = Usd.Stage.Open(str(path))
    for name, value in (("upAxis", up), ("metersPerUnit", metres)):
        stage.SetMetadata(name, value) if value is not None else stage.ClearMetadata(name)
    stage.GetRootLayer().Save()
    return path


@pytest.mark.parametrize(("up", "metres"), [("Y", 1.0), ("Z", 0.01), ("Y", 0.01)])
def test_a_stage_that_says_its_axis_and_unit_comes_to_z_up_and_metres(tmp_path, up, metres):
    as_written = gaussians(60, 4)
    save(as_written, tmp_path / "a.usda")
    plain, found = load(tmp_path / "a.usda"), load(saying(tmp_path / "a.usda", up, metres))
    turn = torch.tensor([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]]) if up == "Y" else torch.eye(3)
    torch.testing.assert_close(found.means, metres * plain.means @ turn.T, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(found.log_scales, plain.log_scales + torch.tensor(metres).log(), rtol=1e-5, atol=1e-5)
    torch.testing.assert_close(matrix_from_quat(found.quats), turn @ matrix_from_quat(plain.quats), rtol=0, atol=1e-5)
    look = torch.nn.functional.normalize(torch.randn(60, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    torch.testing.assert_close(evaluate(found.sh, look @ turn.T), evaluate(plain.sh, look), rtol=1e-4, atol=1e-4)
    save(found, tmp_path / "b.usdc")  # what is written says z and metres
    torch.testing.assert_close(load(tmp_path / "b.usdc").means, found.means, rtol=0, atol=0)


def test_a_stage_that_says_neither_is_taken_as_it_is(tmp_path):
    save(gaussians(60, 4), tmp_path / "a.usda")
    plain, found = load(tmp_path / "a.usda"), load(saying(tmp_path / "a.usda"))
    assert stage_axes(tmp_path / "a.usda") == (None, 1.0)
    for name, tensor in plain.tensors().items():
        assert torch.equal(tensor, getattr(found, name)), name


@pytest.mark.parametrize("metres", [0.0, -1.0, float("nan")])
def test_a_unit_that_is_no_length_is_refused(tmp_path, metres):
    save(gaussians(5), tmp_path / "a.usda")
    with pytest.raises(ValueError, match=r"a\.usda says that its unit is .* metres \(metersPerUnit\), which is no length"):
        load(saying(tmp_path / "a.usda", "Z", metres))


def test_splats_under_a_transform_are_moved_by_it(tmp_path):
    def edit(splats):
        splats.AddTranslateOp().Set(Gf.Vec3d(10, 20, 30))
        splats.AddRotateZOp().Set(90)
        splats.AddScaleOp().Set(Gf.Vec3f(2, 2, 4))

    still, moved = load(foreign(tmp_path / "a.usda")), load(foreign(tmp_path / "b.usda", edit))
    assert moved.means[0].tolist() == pytest.approx([10 - 2 * 2, 20 + 2 * 1, 30 + 4 * 3])  # the splat is at 1, 2, 3
    wide = moved.log_scales.sub(still.log_scales).exp()
    assert sorted(wide[0].tolist()) == pytest.approx([2, 2, 4], rel=1e-4)


def test_invalid_splats_of_a_usd_file_can_be_dropped_and_counted(tmp_path):
    path = foreign(tmp_path / "a.usda", lambda s: s.GetOpacitiesAttr().Set(Vt.FloatArray([0.5, float("nan")])))
    kept, dropped = load_dropping(path)
    assert (len(kept), dropped) == (1, 1)


def test_cut_and_damaged_usd_files_are_refused(tmp_path):
    save(gaussians(400), tmp_path / "a.usdc")
    whole = (tmp_path / "a.usdc").read_bytes()
    for i, cut in enumerate([0, 5, 80, len(whole) // 2, len(whole) - 1]):
        path = tmp_path / f"cut{i}.usdc"
        path.write_bytes(whole[:cut])
        with pytest.raises(ValueError, match=f"cut{i}.usdc"):
            load(path)
    (tmp_path / "text.usda").write_text("hello")
    with pytest.raises(ValueError, match="text.usda is not a valid USD file"):
        load(tmp_path / "text.usda")


def test_flipped_bytes_never_do_worse_than_a_value_error(tmp_path):
    save(asset(count=100), tmp_path / "a.usdc")
    whole, dice = (tmp_path / "a.usdc").read_bytes(), random.Random(216)
    for i in range(60):
        data, path = bytearray(whole), tmp_path / f"flipped{i}.usdc"
        for _ in range(dice.choice([1, 3, 20])):
            data[dice.randrange(len(data))] = dice.randrange(256)
        path.write_bytes(data)
        try:
            load(path)
        except ValueError as error:
            assert path.name in str(error) or "/Asset" in str(error)


NAMES = ("new.usdc", "new.ply", "old.usdc", "old.ply")


def test_a_disk_that_fills_up_leaves_no_file(tmp_path):
    code = f"""
import resource, sys
from randomized import gaussians, scene
from scenes import save
small, large = gaussians(20), gaussians(4000)
save(small, {str(tmp_path / "old.usdc")!r}); save(small, {str(tmp_path / "old.ply")!r})
resource.setrlimit(resource.RLIMIT_FSIZE, (30000, 30000))  # a write beyond fails as on a full disk, and needs no root
for name in {NAMES}:
    try:
        save(large, {str(tmp_path)!r} + "/" + name, overwrite=True)
    except OSError as error:
        print((error.errno, error.filename))
"""
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment())
    assert run.stdout.splitlines() == [repr((errno.EFBIG, str(tmp_path / name))) for name in NAMES]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["old.ply", "old.usdc"]
    assert len(load(tmp_path / "old.ply")) == len(load(tmp_path / "old.usdc")) == 20


def environment():
    return os.environ | {"PYTHONPATH": os.pathsep.join(p for p in sys.path if p)}


def test_names_become_identifiers_that_differ_whatever_the_case():
    names = ["a", "A", "a b", "a_b", "12x", "", "ü", "veh/3", "class"]
    out = valid_names(names, taken=["Veh_3"])
    assert len({v.casefold() for v in out.values()}) == len(names) and list(out) == names
    assert all(v.isascii() and v.isidentifier() for v in out.values())
    assert out["a"] == "a" and out["veh/3"] == "veh_3_2"
    json.dumps(out)
