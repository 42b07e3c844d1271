"""Whether splats were trained with antialiasing goes along with them."""

import gzip
import struct

import pytest
import torch
from randomized import asset, gaussians

from scenes import SplatModel, load, save
from scenes.formats.spz import save_spz
from scenes.formats.trained import model_of
from scenes.opening import open_view
from sidestep import main

MIP = SplatModel(antialias=True)


@pytest.mark.parametrize("name", ["a.ply", "a.compressed.ply", "a.spz", "a.sog", "a.usdc"])
def test_a_format_with_a_place_for_it_keeps_it_and_rendering_heeds_it(tmp_path, name):
    save(gaussians(), tmp_path / name)
    assert open_view(tmp_path / name)[0].model == SplatModel()
    save(gaussians(), tmp_path / name, overwrite=True, model=MIP)
    assert open_view(tmp_path / name)[0].model == MIP


def test_it_survives_conversions_there_and_back(tmp_path, capsys):
    save(asset(), tmp_path / "0.usdc")
    names = ["0.usdc", "1.spz", "2.ply", "3.sog", "4.usdc", "5.spz"]
    for before, after in zip(names, names[1:], strict=False):
        main(["convert", str(tmp_path / before), str(tmp_path / after)])
        assert model_of(tmp_path / after) == MIP
    main(["info", str(tmp_path / "5.spz")])
    assert "antialias True" in capsys.readouterr().out


@pytest.mark.parametrize(
    "comments, antialias",
    [
        ("SplatRenderMode: mip", True),
        ("antialiased 1", True),
        ("splatrendermode: MIP\ncomment antialiased 0", False),
        ("antialiased 0\ncomment SplatRenderMode: Mip", True),
        ("SplatRenderMode: default", False),
        ("not antialiased 1", False),
    ],
)
def test_comments_of_brush_and_postshot_are_understood(tmp_path, comments, antialias):
    save(gaussians(), tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(data.replace(b"element", f"comment {comments}\nelement".encode(), 1))
    assert model_of(tmp_path / "a.ply").antialias == antialias and len(load(tmp_path / "a.ply")) == 20


def test_an_axis_that_brush_calls_vertical_is_told_where_z_is_taken_to_be_up(tmp_path):
    save(gaussians(), tmp_path / "a.ply")
    data = (tmp_path / "a.ply").read_bytes()
    assert not open_view(tmp_path / "a.ply")[1]
    for axis, told in (("y", True), ("z", False)):
        (tmp_path / "b.ply").write_bytes(data.replace(b"element", f"comment Vertical axis: {axis}\nelement".encode(), 1))
        warnings = open_view(tmp_path / "b.ply")[1]
        assert bool(warnings) is told
        assert not told or "its vertical axis is y, and z is taken to point up; give --up=-y" in warnings[0]
        assert not open_view(tmp_path / "b.ply", up="-y")[1]


@pytest.mark.parametrize("name", ["a.glb", "a.spz", "a.ply"])
def test_the_axis_that_is_said_to_be_up_is_the_files_own(tmp_path, name):
    """GLB and SPZ are y up by their texts, and stand upright where that is said once more; a PLY file's z is taken to be up."""
    save(gaussians(), tmp_path / name)
    poses = {up: open_view(tmp_path / name, up=up)[0].background.world_from_local for up in (None, "y", "z")}
    same, other = ("z", "y") if name == "a.ply" else ("y", "z")
    assert torch.equal(poses[same], poses[None]) and not torch.allclose(poses[other], poses[None])


@pytest.mark.parametrize("version", [2, 3, 4])
def test_spz_has_it_as_a_bit(tmp_path, version):
    path = tmp_path / "a.spz"
    save_spz(path, gaussians(), version, antialias=True)
    assert model_of(path) == MIP
    data = path.read_bytes()
    plain = gzip.decompress(data) if version < 4 else data
    assert struct.unpack_from("<4sIIBBB", plain)[5] == 1
