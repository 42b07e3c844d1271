import json
from dataclasses import replace

import pytest
import torch
from randomized import gaussians
from street import box, car, street

from recon.assets import adding
from recon.assets.adding import add_splats, check_databank, holds_splats, turned_upright
from recon.assets.backwards import backwards
from recon.assets.overturned import overturned
from scenes import Asset, Databank, Gaussians, save
from scenes.harmonics import sh_from_rgb
from scenes.poses import matrix_from_quat
from scenes.sizes import SIZES, odd_size


def lying(tmp_path):
    """A car in a camera's axes (x right, y down, z forward), a thousandth of its size, off its origin; and where it was."""
    upright = box((4.2, 1.8, 1.5), (0.8, 0.2, 0.1))
    turn = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # camera from asset
    means = (upright.means @ turn.T + torch.tensor([3.0, 1.0, 7.0])) / 1000
    splats = type(upright)(means, upright.quats, upright.log_scales - torch.tensor(1000.0).log(), upright.logit_opacities, upright.sh)
    save(splats, tmp_path / "car.ply")
    return tmp_path / "car.ply", upright


def test_splats_of_any_axes_and_unit_become_an_asset(tmp_path):
    file, upright = lying(tmp_path)
    id, said = add_splats(tmp_path / "bank", file, "car", 1000.0, "-y", "z", {"licence": "CC0-1.0"})
    asset = Databank(tmp_path / "bank").load(id)
    assert id == "car/0001" and "4.20 m long, 1.80 m wide, 1.50 m high" in said
    torch.testing.assert_close(asset.gaussians.means, upright.means, atol=2e-3, rtol=0)
    assert Databank(tmp_path / "bank").entry(id).thumb and check_databank(tmp_path / "bank") == []


@pytest.mark.parametrize(
    ("name", "up", "units"), [("car.glb", None, 1.0), ("car.spz", None, 1.0), ("z.usda", "Z", 1.0), ("y.usda", "Y", 100.0)]
)
def test_splats_in_files_that_say_which_axis_is_up_need_no_axes(tmp_path, name, up, units):
    """A car that faces as its format has it: glTF along z with y up, SPZ along -z; USD along x with z up, and along z with y up."""
    upright, file = box((4.2, 1.8, 1.5), (0.8, 0.2, 0.1)), tmp_path / name
    turn = torch.tensor([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]]) if up is None else torch.eye(3)
    turn = turn.T if name == "car.spz" else turn
    turn = torch.tensor([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]]) if up == "Y" else turn
    grown = upright.log_scales + torch.tensor(units).log()
    save(replace(upright, means=units * upright.means @ turn.T, log_scales=grown), file)
    if up == "Y":
        text = file.read_text().replace('upAxis = "Z"', 'upAxis = "Y"').replace("metersPerUnit = 1", "metersPerUnit = 0.01")
        file.write_text(text)
    own = (up or "Y").lower(), {"car.spz": "-z", "z.usda": "x"}.get(name, "z")
    axes = [(None, None, None), (1 / units, *own)]
    for scale, up_axis, forward in axes:  # what is said once more, of the file as it is, changes nothing
        id, _ = add_splats(tmp_path / "bank", file, "car", scale, up_axis, forward, {})
        torch.testing.assert_close(Databank(tmp_path / "bank").load(id).gaussians.means, upright.means, atol=2e-3, rtol=0)


def test_splats_of_a_usd_file_that_says_no_axis_stand_as_cameras_see_them(tmp_path):
    upright, file = box((4.2, 1.8, 1.5), (0.8, 0.2, 0.1)), tmp_path / "car.usda"
    turn = torch.tensor([[0.0, -1, 0], [0, 0, -1], [1, 0, 0]])  # x forward to z, y left to -x, z up to -y
    save(replace(upright, means=upright.means @ turn.T), file)
    file.write_text("".join(line for line in file.read_text().splitlines(True) if "upAxis" not in line and "metersPerUnit" not in line))
    id, _ = add_splats(tmp_path / "bank", file, "car", None, None, None, {})
    torch.testing.assert_close(Databank(tmp_path / "bank").load(id).gaussians.means, upright.means, atol=2e-3, rtol=0)


def test_an_asset_and_a_scene_are_refused_with_what_makes_one_of_them(tmp_path):
    save(car(), tmp_path / "car.usdc")
    save(street(), tmp_path / "s1")
    for file, fix in (("car.usdc", r"sidestep convert \S*/car.usdc car.ply, .*--up z --forward x"), ("s1/scene.usda", r"extract \S*/s1 ")):
        with pytest.raises(ValueError, match=fix):
            add_splats(tmp_path / "bank", tmp_path / file, "car", None, None, None, {})


def test_turning_splats_turns_their_axes_and_their_harmonics():
    from scenes.harmonics import evaluate

    g = gaussians(50)
    turned = turned_upright(g, 2.0, "-y", "z")
    rotation = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    torch.testing.assert_close(turned.means, 2 * g.means @ rotation.T)
    torch.testing.assert_close(matrix_from_quat(turned.quats), rotation @ matrix_from_quat(g.quats), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(turned.log_scales.exp(), 2 * g.log_scales.exp())
    look = torch.nn.functional.normalize(torch.randn(50, 3, generator=torch.Generator().manual_seed(0)), dim=1)
    torch.testing.assert_close(evaluate(turned.sh, look @ rotation.T), evaluate(g.sh, look), atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    ("scale", "up", "forward", "said"),
    [
        (1.0, "-y", "z", "a car has 2.5 x 1.3 x 1 to 6 x 2.6 x 2.3 m"),
        (1e6, "-y", "z", "the scale is not the file's; give --scale 1000"),
        (1000.0, "-y", "x", "stand across, or to lie on its side; give another --forward or --up, or --force"),
        (1000.0, "z", "y", "lie on its side; give another --up"),
    ],
)
def test_a_wrong_size_or_axis_is_refused_with_its_cause(tmp_path, scale, up, forward, said):
    file, _ = lying(tmp_path)
    with pytest.raises(ValueError, match="or --force") as refused:
        add_splats(tmp_path / "bank", file, "car", scale, up, forward, {})
    assert said in str(refused.value)
    assert not (tmp_path / "bank").exists()
    add_splats(tmp_path / "bank", file, "car", scale, up, forward, {}, force=True)
    assert any("car/0001 is" in p for p in check_databank(tmp_path / "bank"))


@pytest.mark.parametrize("label", SIZES)
def test_things_in_the_middle_of_their_class_are_not_odd(label):
    assert odd_size(label, [(a * b) ** 0.5 for a, b in SIZES[label]]) == ""


def test_what_may_stand_across_or_lie_on_its_side_is_told_both_and_the_axes_of_cad_where_they_help():
    """As a car with z up and x ahead is read by default; by another --forward alone it would be stored on its side."""
    both = "stand across, or to lie on its side; give another --forward or --up"
    assert odd_size("car", (1.6, 4.3, 1.85), axes=("y", "z")).endswith(f"{both}, as --up z --forward x, which CAD and robots use")
    assert odd_size("car", (1.6, 4.3, 1.85), axes=("z", "y")).endswith(both) and odd_size("car", (1.6, 4.3, 1.85)).endswith(both)
    assert odd_size("motorcycle", (0.9, 2.9, 2.2)).endswith("seems to stand across; give another --forward")
    assert "on its side; give another --up, as --up z --forward x" in odd_size("pedestrian", (1.8, 0.3, 0.5), axes=("-y", "z"))


@pytest.mark.parametrize("size", [(0.002, 0.75, 2.5), (0.75, 1e-3, 0.75)])
def test_a_sheet_is_no_odd_sign_but_a_tiny_or_a_flat_lying_one_is(size):
    assert odd_size("sign", size) == odd_size("board", size) == ""
    assert "in millimetres" in odd_size("sign", [1000 * v for v in size])
    assert "in kilometres" in odd_size("sign", [v / 1000 for v in size]) and odd_size("car", [0.002, 1.8, 1.5])
    assert "on its side" in odd_size("sign", (0.75, 2.0, 1e-3))


def test_splats_in_a_plane_become_a_sign(tmp_path):
    """Whose box has some thickness all the same, and in which nothing is missing."""
    flat = box((1.0, 0.8, 2.0), (0.8, 0.2, 0.1))
    save(replace(flat, means=flat.means * torch.tensor([0.0, 1.0, 1.0])), tmp_path / "sign.ply")
    id, said = add_splats(tmp_path / "bank", tmp_path / "sign.ply", "sign", None, "z", "x", {})
    assert "0.00 m long, 0.80 m wide, 2.00 m high" in said and check_databank(tmp_path / "bank") == []


def test_a_class_is_known_however_it_is_written():
    assert "a Car has" in odd_size("Car", [24, 11, 8.6]) and odd_size("CAR", [4.5, 1.8, 1.5]) == ""


def test_check_finds_what_is_broken_misplaced_or_turned(tmp_path):
    bank = Databank(tmp_path / "bank")
    good = car()
    bank.add(good)
    assert check_databank(bank.path) == []
    g = good.gaussians
    bank.add(Asset(type(g)(g.means - torch.tensor([0, 0, 0.75]), *list(g.tensors().values())[1:]), good.size, "car"))
    bank.add(Asset(g, good.size[[1, 0, 2]], "car"))
    bank.add(Asset(type(g)(0.3 * g.means, *list(g.tensors().values())[1:]), good.size, "car"))
    bank.add(good)
    (bank.path / "assets/car/0005/asset.usdc").write_bytes(b"cut")
    problems = "\n".join(check_databank(bank.path))
    for id, said in (("0002", "its origin or axes are wrong"), ("0003", "stand across"), ("0004", "scale or axes"), ("0005", "")):
        assert f"car/{id}" in problems and said in problems, id
    assert "car/0001" not in problems


def saloon() -> Asset:
    """A car with a cabin, which `car` has not."""
    cabin = box((2.2, 1.6, 0.7), (0.2, 0.2, 0.2))
    splats = Gaussians.cat([box((4.2, 1.8, 0.8), (0.8, 0.1, 0.1)), replace(cabin, means=cabin.means + torch.tensor([-0.2, 0.0, 0.8]))])
    return Asset(splats, (4.2, 1.8, 1.5), "car")


def test_a_car_on_its_head_is_found_and_refused(tmp_path):
    file, bank = tmp_path / "saloon.ply", Databank(tmp_path / "bank")
    save(saloon().gaussians, file)
    with pytest.raises(ValueError, match=r"saloon\.ply is longer above than below.* on its head; give --up=z, or --force"):
        add_splats(bank.path, file, "car", None, "-z", "x", {})
    assert add_splats(bank.path, file, "car", None, "z", "x", {})[0] == "car/0001" and check_databank(bank.path) == []
    add_splats(bank.path, file, "car", None, "-z", "x", {}, force=True)
    assert check_databank(bank.path) == ["car/0002 is longer above than below: it stands on its head"]
    add_splats(bank.path, file, "stand", None, "-z", "x", {})  # of most classes nobody knows


def test_a_ply_is_known_to_hold_splats_or_a_mesh(tmp_path):
    import trimesh

    file, _ = lying(tmp_path)
    trimesh.creation.box().export(tmp_path / "mesh.ply")
    assert holds_splats(file) and not holds_splats(tmp_path / "mesh.ply") and not holds_splats(tmp_path / "a.glb")


def test_the_index_of_a_mesh_tells_its_licence(tmp_path):
    file, _ = lying(tmp_path)
    add_splats(tmp_path / "bank", file, "car", 1000.0, None, None, {"licence": "CC BY 3.0", "attribution": "OSRF"})
    (entry,) = json.loads((tmp_path / "bank" / "index.json").read_text())["entries"]
    assert (entry["licence"], entry["attribution"], entry["source"]) == ("CC BY 3.0", "OSRF", "car.ply")


def test_a_databank_that_takes_nothing_is_told_before_the_fit(tmp_path, monkeypatch):
    monkeypatch.setattr(adding, "read_mesh", lambda *_: pytest.fail("it is looked at first"))
    (tmp_path / "bank").mkdir()
    (tmp_path / "bank/index.json").write_text("{")
    (tmp_path / "file").write_text("")
    for name, said in (("bank", "index.json is corrupt"), ("file", "file is a file; a databank is a folder")):
        with pytest.raises(ValueError, match=said):
            adding.add_mesh(tmp_path / name, tmp_path / "car.glb", "car", None, None, None, {})


def test_the_scale_that_is_advised_counts_the_one_that_was_given():
    metres = (4.2, 1.8, 1.5)
    assert "give --scale 0.001" in odd_size("car", [1000 * v for v in metres])
    assert "the scale is not the file's; give --scale 1" in odd_size("car", [1000 * v for v in metres], scale=1000.0).replace(":", ";")
    advised = float(odd_size("car", [0.1 * v for v in metres], scale=0.1).split("--scale ")[1].split()[0])
    assert 0.7 < advised < 1.4


@pytest.mark.parametrize("metres", [0.1, 4.0])
def test_what_is_longer_above_than_below_is_overturned_however_large(metres):
    z, x = (v.flatten() for v in torch.meshgrid(torch.linspace(0, 1, 20), torch.linspace(-0.5, 0.5, 20), indexing="ij"))
    cone = metres * torch.stack([x * (1 - 0.7 * z), 0 * x, z], 1)
    turned = cone * torch.tensor([1.0, 1.0, -1.0])
    assert overturned("cone", turned) and not overturned("cone", cone) and not overturned("truck", turned)
    assert not overturned("cone", cone[:0])


def lamped(body=(0.7, 0.7, 0.7), rear=1.0) -> Gaussians:
    """A car's sides and ends, with two red lamps at the end behind, or, where `rear` is -1, in front."""
    points = torch.rand(8000, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor([4.2, 1.8, 1.5]) - torch.tensor([2.1, 0.9, 0.0])
    rgb = torch.tensor(body).repeat(len(points), 1)
    lamps = (points[:, 0] * -rear > 1.95) & (points[:, 1].abs() > 0.6) & ((points[:, 2] - 0.8).abs() < 0.15)
    rgb[lamps] = torch.tensor([0.7, 0.05, 0.05])
    splats = gaussians(len(points))
    return replace(splats, means=points, sh=sh_from_rgb(rgb)[:, None], logit_opacities=torch.full((len(points),), 3.0))


def test_a_vehicle_with_red_lamps_in_front_is_told_to_face_backwards(tmp_path):
    bank = Databank(tmp_path / "bank")
    for name, rear in (("ahead", 1.0), ("back", -1.0)):
        save(lamped(rear=rear), tmp_path / f"{name}.ply")
    _, said = add_splats(bank.path, tmp_path / "ahead.ply", "car", None, "z", "x", {})
    assert "backwards" not in said and check_databank(bank.path) == []
    id, said = add_splats(bank.path, tmp_path / "back.ply", "car", None, "z", "x", {})
    assert "it seems to face backwards; if it does, add it with --forward=-x" in said
    assert len(problems := check_databank(bank.path)) == 1 and problems[0].startswith(f"{id} has red lamps in front and none behind")
    _, said = add_splats(bank.path, tmp_path / "back.ply", "car", None, "z", "-x", {})
    assert "backwards" not in said


def test_of_a_red_car_or_of_no_car_nobody_knows_which_way_it_faces():
    size = torch.tensor([4.2, 1.8, 1.5])
    assert backwards(Asset(lamped(rear=-1.0), size, "van"))
    assert not backwards(Asset(lamped((0.6, 0.05, 0.05), rear=-1.0), size, "car"))
    assert not backwards(Asset(lamped(rear=-1.0), size, "hydrant"))
    assert not backwards(Asset(lamped(rear=-1.0).select(torch.arange(300)), size, "car"))
