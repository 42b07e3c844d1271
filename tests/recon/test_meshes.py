"""Meshes become assets: axes and scale, the tracer against what is known of a box, and the fit against the tracer."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from made_glb import rewritten

from recon.assets.looking import looking_at
from recon.assets.mesh_files import read_mesh, turn_to_asset
from recon.assets.mesh_splats import sampled, splats_of_mesh
from recon.assets.meshes import MeshFit, asset_of_mesh, likeness, views_around
from render.rays import camera_rays
from render.tracer import Blockers, TracedMesh, fibonacci, lit
from scenes.harmonics import rgb_from_sh
from scenes.poses import matrix_from_quat

SIZE = (4.0, 1.8, 1.5)  # length, width, height
PBR = trimesh.visual.material.PBRMaterial


def write_box(path: Path, inner: bool = False) -> Path:
    """A car-sized box in glTF's axes: its nose (+z) red, its left (+x) green, its top blue, the rest grey, of one texture."""
    length, width, height = SIZE
    box = trimesh.creation.box((width, height, length))
    box.apply_translation((0, height / 2, 0))
    box.unmerge_vertices()
    colours = np.array([[200, 30, 30, 255], [30, 160, 30, 255], [30, 30, 200, 255], [128, 128, 128, 255]], np.uint8)
    normals = box.face_normals
    which = np.select([normals[:, 2] > 0.9, normals[:, 0] > 0.9, normals[:, 1] > 0.9], [0, 1, 2], 3)
    uv = np.stack([(which[:, None] + 0.5) / 4 * np.ones((1, 3)), np.full((len(which), 3), 0.5)], -1).reshape(-1, 2)
    from PIL import Image

    image = Image.fromarray(np.repeat(np.repeat(colours[None], 16, 1), 16, 0))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=image)
    box.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    parts = [box]
    if inner:
        smaller = trimesh.creation.box((width / 2, height / 2, length / 2))
        parts.append(smaller.apply_translation((0, 0.7, 0)))
    trimesh.Scene(parts).export(path)
    return path


@pytest.fixture(scope="module")
def box(tmp_path_factory) -> Path:
    return write_box(tmp_path_factory.mktemp("mesh") / "box.glb")


def view(*eye: float, pixels=(96, 72)):
    return looking_at(torch.tensor([0.0, 0.0, 0.75], dtype=torch.float64), torch.tensor(eye, dtype=torch.float64), *pixels)


def test_a_gltf_stands_upright_and_faces_forward(box):
    mesh = read_mesh(box)
    np.testing.assert_allclose(mesh.vertices.min(0), [-2, -0.9, 0], atol=1e-5)
    np.testing.assert_allclose(mesh.vertices.max(0), [2, 0.9, 1.5], atol=1e-5)
    traced = TracedMesh(mesh)
    for eye, channel in (((9.0, 0.0, 0.75), 0), ((0.0, 9.0, 0.75), 1), ((0.001, 0.0, 9.0), 2)):
        rgb = traced.render(view(*eye)).rgb[36, 48]
        assert int(rgb.argmax()) == channel and rgb.max() > 2 * rgb.median(), eye


def test_other_axes_and_scales_are_turned_and_scaled(box):
    mesh = read_mesh(box, up="z", forward="-x", scale=0.5)
    np.testing.assert_allclose(mesh.vertices.max(0) - mesh.vertices.min(0), [0.9, 0.75, 2.0], atol=1e-5)
    for up in ("x", "-y", "z"):
        for forward in ("y", "-z", "x", "-x"):
            if up[-1] != forward[-1]:
                turn = turn_to_asset(up, forward)
                np.testing.assert_allclose(turn @ turn.T, np.eye(3))
                assert np.linalg.det(turn) == pytest.approx(1)
    with pytest.raises(ValueError, match="lie along one axis"):
        turn_to_asset("y", "-y")
    with pytest.raises(ValueError, match='--up "w" is not an axis'):
        turn_to_asset("w", "x")


def test_a_traced_box_is_hit_where_geometry_says(box):
    traced, camera = TracedMesh(read_mesh(box)), view(9.0, 2.0, 3.0)
    pose = camera.world_from_cam.float()
    rays = torch.nn.functional.normalize(camera_rays(camera).reshape(-1, 3) @ pose[:3, :3].T, dim=1)
    _, normals, distance = traced.trace(pose[:3, 3].expand(len(rays), 3), rays)
    low, high = torch.tensor([-2.0, -0.9, 0.0]), torch.tensor([2.0, 0.9, 1.5])
    ends = torch.stack([(low - pose[:3, 3]) / rays, (high - pose[:3, 3]) / rays])
    near, far = ends.amin(0).amax(1), ends.amax(0).amin(1)
    clear = (near - far).abs() > 1e-2  # rays along an edge may fall on either side of it
    expected = torch.where(near < far, near, torch.inf)
    torch.testing.assert_close(distance[clear], expected[clear], atol=1e-3, rtol=0)
    hit = torch.isfinite(distance)
    assert ((normals[hit] * rays[hit]).sum(1) < 0).all()


def test_the_light_of_two_half_spheres_is_that_of_their_cosine_integral():
    directions = fibonacci(20_000)
    radiance = torch.where(directions[:, 2:] > 0, 1.0, 0.3)
    for normal in torch.nn.functional.normalize(torch.tensor([[0.0, 0, 1], [1.0, 0, 0], [1.0, 1, -2], [0.0, 0, -1]]), dim=1):
        integral = float((radiance[:, 0] * (directions @ normal).clamp_min(0)).mean() * 4)  # over pi
        from scenes.sky import linear_from_srgb

        assert float(linear_from_srgb(lit(torch.ones(1, 3), normal[None]))[0, 0]) == pytest.approx(integral, abs=2e-3)


def test_a_plate_blocks_the_directions_that_it_covers():
    plate = np.array([[[-1, -1, 1], [1, -1, 1], [1, 1, 1]], [[-1, -1, 1], [1, 1, 1], [-1, 1, 1]]], np.float32)
    directions = fibonacci(4000)
    directions = directions[directions[:, 2] > 0]
    weights = directions[:, 2].contiguous()
    points = torch.tensor([[0.0, 0, 0], [0.0, 0, 2], [50.0, 0, 0]])
    share = Blockers(plate).open_share(points, directions, weights, 10.0)
    # the form factor of a 2 x 2 plate 1 m above: 4 (2 / pi) (1 / sqrt 2) atan(1 / sqrt 2) / 2 = 0.554
    assert share.tolist() == pytest.approx([1 - 0.554, 1.0, 1.0], abs=0.01)


def test_splats_lie_flat_on_what_can_be_seen(tmp_path):
    splats = splats_of_mesh(read_mesh(write_box(tmp_path / "nested.glb", inner=True)), 2000)
    assert 1600 < len(splats) < 2400
    edge = torch.tensor(SIZE) / 2
    off = (splats.means - torch.tensor([0, 0, SIZE[2] / 2])).abs() - edge
    assert off.amax(1).abs().max() < 1e-4  # on the skin; none of the box within
    axis = off.argmax(1)
    normals = matrix_from_quat(splats.quats)[:, :, 2].abs()
    assert (normals[torch.arange(len(axis)), axis] > 0.999).all()


def test_a_surface_that_faces_inwards_is_seen_from_outside_all_the_same(box):
    mesh = read_mesh(box)
    inwards = replace(mesh, faces=mesh.faces[:, ::-1].copy())
    assert len(splats_of_mesh(inwards, 500)) == len(splats_of_mesh(mesh, 500)) > 400


def test_a_fitted_asset_looks_as_its_mesh_does_from_views_it_never_saw(box):
    config = MeshFit(splats=2500, views=16, steps=120, size=(96, 72))
    mesh = read_mesh(box)
    asset = asset_of_mesh(mesh, "car", {"licence": "CC0-1.0"}, config)
    assert asset.size.tolist() == pytest.approx(SIZE, abs=1e-4) and asset.meta["licence"] == "CC0-1.0"
    before, _ = likeness(splats_of_mesh(mesh, config.splats), TracedMesh(mesh), views_around(np.array(SIZE), 8, (96, 72), 0.37))
    assert asset.meta["psnr_unseen_whole_picture"] > max(30, before + 3)
    assert asset.meta["psnr_unseen"] > 25


def test_a_file_that_is_no_mesh_says_so(tmp_path):
    (tmp_path / "a.glb").write_bytes(b"nothing of the kind")
    with pytest.raises(ValueError, match="a.glb does not read as a mesh"):
        read_mesh(tmp_path / "a.glb")
    with pytest.raises(FileNotFoundError):
        read_mesh(tmp_path / "b.glb")
    with pytest.raises(ValueError, match="is a folder; give one mesh file of it"):
        read_mesh(tmp_path)


def wide_box(path: Path, uv: float, **material) -> Path:
    box = trimesh.creation.box((1.8, 1.5, 4.2))
    box.visual = trimesh.visual.TextureVisuals(uv=np.full((len(box.vertices), 2), uv), material=PBR(**material))
    trimesh.Scene([box]).export(path)
    return path


def test_what_cannot_be_seen_is_refused_before_it_is_fitted(tmp_path):
    from PIL import Image

    file, picture = tmp_path / "car.glb", Image.new("RGB", (4, 4), (188, 30, 30))
    with pytest.raises(ValueError, match="car.glb has texture coordinates that are not finite"):
        read_mesh(wide_box(file, float("nan"), baseColorTexture=picture))
    with pytest.raises(ValueError, match="car.glb is see-through all over"):
        read_mesh(wide_box(file, 0.5, baseColorFactor=[255, 255, 255, 0], alphaMode="BLEND"))
    line = np.array([[-0.9, 0, -2], [0.9, 1.5, 2], [0, 0.75, 0]])
    trimesh.Trimesh(line, [[0, 1, 2]], process=False).export(tmp_path / "line.glb")
    with pytest.raises(ValueError, match="line.glb has no triangle of any area"):
        read_mesh(tmp_path / "line.glb")


def test_a_truncated_file_says_so(box, tmp_path):
    (tmp_path / "a.glb").write_bytes(box.read_bytes()[:-100])
    with pytest.raises(ValueError, match=r"claims glTF 2, \d+ bytes; it has \d+; fetch"):
        read_mesh(tmp_path / "a.glb")


def test_what_stands_behind_a_whole_glb_file_is_not_read(box, tmp_path):
    (tmp_path / "a.glb").write_bytes(box.read_bytes() + b"\n" * 12)
    assert np.array_equal(read_mesh(tmp_path / "a.glb").vertices, read_mesh(box).vertices)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.update(extensionsRequired=["KHR_draco_mesh_compression"]), "requires KHR_draco_mesh_compression, which is not read"),
        (lambda t: t.update(extensionsRequired=["KHR_texture_transform"]), "requires KHR_texture_transform, which is not read"),
        (lambda t: t.update(images=[{"uri": "gone%20far.png"}]), "gone far.png, which it names, is not beside it"),
        (lambda t: t.update(images=[{"uri": "../gone.png"}]), "../gone.png, which it names, is not beside it"),
        (lambda t: t["accessors"][attributes(t)["TEXCOORD_0"]].update(normalized=True), "its TEXCOORD_0 are quantized"),
        (lambda t: t["accessors"][attributes(t)["POSITION"]].update(count=8), "triangles of vertices that it does not hold"),
    ],
    ids=["compressed", "turned textures", "lost picture", "picture outside", "quantized", "few vertices"],
)
def test_what_would_look_otherwise_than_it_is_meant_is_refused(box, tmp_path, change, said):
    (tmp_path / "in").mkdir()
    (tmp_path / "gone.png").touch()
    file = tmp_path / "in" / "a.glb"
    file.write_bytes(box.read_bytes())
    rewritten(file, change)
    with pytest.raises(ValueError, match=said):
        read_mesh(file)


def attributes(tree: dict) -> dict:
    return tree["meshes"][0]["primitives"][0]["attributes"]


def test_a_picture_beside_whose_name_is_escaped_is_found(box, tmp_path):
    from PIL import Image

    file = tmp_path / "a.glb"
    file.write_bytes(box.read_bytes())
    Image.new("RGB", (4, 4), (200, 0, 0)).save(tmp_path / "all red.png")
    rewritten(file, lambda tree: tree.update(images=[{"uri": "all%20red.png"}]))
    assert (_textures(file)[:, :3] == (200, 0, 0)).all()


@pytest.mark.filterwarnings("error")
def test_vertices_that_are_not_finite_are_refused_without_further_words(tmp_path):
    box = trimesh.creation.box((1.8, 1.5, 4.2))
    vertices = box.vertices.copy()
    vertices[0] = np.inf
    trimesh.Trimesh(vertices, box.faces, process=False).export(tmp_path / "car.ply")
    with pytest.raises(ValueError, match="car.ply has vertices that are not finite"):
        read_mesh(tmp_path / "car.ply")


def _textures(path: Path) -> np.ndarray:
    """Every colour that the mesh of a file has at a corner of a face, uint8 `[F, 4]` a face: at its first one."""
    mesh = read_mesh(path, up="z", forward="x")
    colours = []
    for uv, tint, which in zip(np.asarray(mesh.uvs), mesh.tints, mesh.texture, strict=True):
        texture = mesh.textures[int(which)]
        u, v = (uv[0] * (texture.shape[1], texture.shape[0])).astype(int)
        colours.append((texture[min(v, texture.shape[0] - 1), min(u, texture.shape[1] - 1)] * tint[0]).round())
    return np.array(colours)


def test_a_texture_of_sixteen_bits_is_shown_as_eight(tmp_path):
    """PIL alone makes all of it that is not black white."""
    from PIL import Image

    file = wide_box(tmp_path / "a.glb", 0.5, baseColorTexture=Image.fromarray(np.full((4, 4), 100 * 257, np.uint16)))
    assert read_mesh(file).textures[0].reshape(-1, 4).tolist() == 16 * [[100, 100, 100, 255]]


def test_a_texture_of_an_obj_file_is_upright(tmp_path):
    """Its v goes up: a board whose picture is red above and blue below."""
    from PIL import Image

    Image.fromarray(np.repeat(np.uint8([[[200, 0, 0]], [[0, 0, 200]]]), 4, 0).repeat(8, 1)).save(tmp_path / "paint.png")
    (tmp_path / "board.mtl").write_text("newmtl paint\nmap_Kd paint.png\n")
    corners = [(-1, 0), (1, 0), (1, 2), (-1, 2)]
    places = "".join(f"v {x} {y} 0\nvt {(x + 1) / 2} {y / 2}\n" for x, y in corners)
    (tmp_path / "board.obj").write_text(f"mtllib board.mtl\n{places}usemtl paint\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n")
    splats = sampled(read_mesh(tmp_path / "board.obj"), 200)
    red, _, blue = rgb_from_sh(splats.sh[:, 0]).T
    within = splats.means[:, 2] > 0  # at v = 1 the picture begins anew
    assert ((red > blue) == (splats.means[:, 2] > 1))[within].all() and 80 < (red > blue).sum() < 120


def board(folder: Path, libraries: str, picture: str) -> Path:
    """An OBJ board with such lines of material libraries; car.mtl, which lies in the folder, has the picture."""
    (folder / "car.mtl").write_text(f"newmtl paint\nKd 1 1 1\n{picture}\n")
    corners = "v 0 0 0\nv 2 0 0\nv 2 2 0\nvt 0 0\nvt 1 0\nvt 1 1\n"
    (folder / "board.obj").write_text(f"{libraries}\n{corners}usemtl paint\nf 1/1 2/2 3/3\n")
    return folder / "board.obj"


@pytest.mark.parametrize(
    "picture",
    [
        "map_Kd red.png",
        "\tMAP_KD -s 1 1 1 -clamp on red.png ",
        r"map_Kd C:\me\red.png",
        r"map_Kd in\blood red.png",
        'map_Kd "red.png"',
    ],
    ids=["plain", "options", "other machine", "folder", "quoted"],
)
def test_a_picture_of_an_obj_file_is_found_however_it_is_named(tmp_path, picture):
    from PIL import Image

    (tmp_path / "in").mkdir()
    for name in ("red.png", "in/blood red.png"):
        Image.new("RGB", (4, 4), (200, 0, 0)).save(tmp_path / name)
    (tmp_path / "first.mtl").write_text("newmtl other\n")
    for libraries in ("mtllib car.mtl", "mtllib first.mtl\r\nmtllib car.mtl\r"):
        assert (_textures(board(tmp_path, libraries, picture))[:, :3] == (200, 0, 0)).all()


@pytest.mark.parametrize(
    ("libraries", "picture", "said"),
    [
        ("mtllib gone.mtl", "", "gone.mtl, which it names, is not beside it or in a folder there"),
        ("mtllib car.mtl", "map_Kd -s 1 1 1 gone far.png", r"\(ValueError: gone far.png, which it names, is not beside it"),
        ("mtllib car.mtl", r"map_Kd in\gone.png", r"in\\gone.png, which it names, is not beside it"),
        ("mtllib car.mtl", "map_Kd -o 0 0 -s 2 2 1 car.mtl", "car.mtl moves or repeats car.mtl by -s 2 2 1, which is not read"),
    ],
    ids=["lost materials", "lost picture", "lost in a folder", "repeated"],
)
def test_an_obj_file_of_which_something_is_missing_is_refused_and_not_white(tmp_path, libraries, picture, said):
    with pytest.raises(ValueError, match=said):
        read_mesh(board(tmp_path, libraries, picture))


def test_an_obj_file_that_names_no_materials_is_grey(tmp_path):
    assert read_mesh(board(tmp_path, "", "")).faces.shape == (1, 3)


@pytest.mark.parametrize("textured", [False, True], ids=["no coordinates", "coordinates"])
def test_a_plain_colour_of_gltf_is_linear(tmp_path, textured):
    box = trimesh.creation.box((4, 1.8, 1.5))
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=np.array([204, 26, 26, 255], np.uint8))
    uv = np.full((len(box.vertices), 2), 0.5) if textured else None
    box.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    trimesh.Scene([box]).export(tmp_path / "plain.glb")
    assert np.abs(_textures(tmp_path / "plain.glb").astype(int) - [231, 90, 90, 255]).max() <= 1


def test_a_picture_is_darkened_by_its_factor_in_linear_light(tmp_path):
    from PIL import Image

    box = trimesh.creation.box((4, 1.8, 1.5))
    material = trimesh.visual.material.PBRMaterial(
        baseColorTexture=Image.new("RGB", (4, 4), (188, 188, 188)), baseColorFactor=np.array([128, 128, 128, 255], np.uint8)
    )
    box.visual = trimesh.visual.TextureVisuals(uv=np.full((len(box.vertices), 2), 0.5), material=material)
    trimesh.Scene([box]).export(tmp_path / "half.glb")
    assert np.abs(_textures(tmp_path / "half.glb")[:, :3].astype(int) - 137).max() <= 1  # half of linear 0.5 is 0.25


def test_every_face_has_its_own_colour(tmp_path):
    box = trimesh.creation.box((4, 1.8, 1.5))
    box.visual.face_colors = np.array([[200, 30, 30, 255], [30, 30, 200, 255]] * (len(box.faces) // 2), np.uint8)
    box.export(tmp_path / "faces.ply")
    found = {tuple(c) for c in _textures(tmp_path / "faces.ply")[:, :3].tolist()}
    assert found == {(200, 30, 30), (30, 30, 200)}


def gltf_box(path: Path, material=None, colours=None) -> Path:
    """A box of glTF with a material, or none, and vertex colours `[4]` of bytes, or none."""
    box = trimesh.creation.box((4, 1.8, 1.5))
    colours = None if colours is None else np.tile(np.array(colours, np.uint8), (len(box.vertices), 1))
    if material is not None:
        box.visual = trimesh.visual.TextureVisuals(uv=np.full((len(box.vertices), 2), 0.5), material=material)
        if colours is not None:
            box.visual.vertex_attributes["color"] = colours
    elif colours is not None:
        box.visual.vertex_colors = colours
    trimesh.Scene([box]).export(path)
    return path


@pytest.mark.parametrize(
    ("material", "colours", "seen"),
    [
        ({}, None, [255, 255, 255, 255]),
        (None, None, [255, 255, 255, 255]),
        ({}, [128, 26, 255, 255], [188, 90, 255, 255]),
        (None, [128, 26, 255, 0], [188, 90, 255, 255]),
        ({"baseColorFactor": [128, 128, 128, 255]}, [128, 128, 128, 0], [137, 137, 137, 255]),
        ({"baseColorFactor": [255, 255, 255, 204], "alphaMode": "BLEND"}, [255, 255, 255, 204], [255, 255, 255, 163]),
    ],
    ids=["no factor", "no material", "colours", "colours without a material", "opaque", "blended"],
)
def test_what_gltf_leaves_out_is_white_and_vertex_colours_are_factors_in_linear_light(tmp_path, material, colours, seen):
    material = None if material is None else PBR(**{"name": "paint", **material})
    assert np.abs(_textures(gltf_box(tmp_path / "box.glb", material, colours)) - seen).max() <= 2


def test_vertex_colours_of_16_bits_are_no_bytes_without_a_material(tmp_path):
    path = gltf_box(tmp_path / "box.glb", None, [128, 26, 255, 255])
    body = path.read_bytes()[28 + struct.unpack_from("<I", path.read_bytes(), 12)[0] :]
    wide = np.tile(np.array([32896, 6656, 65535, 65535], "<u2"), (8, 1)).tobytes()

    def widen(tree):
        (primitive,) = tree["meshes"][0]["primitives"]
        assert "material" not in primitive
        tree["accessors"][primitive["attributes"]["COLOR_0"]] |= {"componentType": 5123, "bufferView": len(tree["bufferViews"])}
        tree["bufferViews"].append({"buffer": 0, "byteOffset": len(body), "byteLength": len(wide)})
        tree["buffers"][0]["byteLength"] = len(body + wide)

    rewritten(path, widen, body + wide)
    assert np.abs(_textures(path) - [188, 90, 255, 255]).max() <= 2


def test_a_gltf_file_with_its_buffer_beside_it_is_read_too(tmp_path):
    box = trimesh.creation.box((4, 1.8, 1.5))
    box.visual.vertex_colors = np.tile(np.array([128, 26, 255, 255], np.uint8), (len(box.vertices), 1))
    for name, data in trimesh.exchange.gltf.export_gltf(trimesh.Scene([box])).items():
        (tmp_path / name).write_bytes(data)
    assert np.abs(_textures(tmp_path / "model.gltf") - [188, 90, 255, 255]).max() <= 2


def test_a_tinted_mesh_is_traced_and_sampled_in_its_tint(tmp_path):
    mesh = read_mesh(gltf_box(tmp_path / "box.glb", PBR(baseColorFactor=[255, 255, 255, 255]), [255, 26, 26, 255]), up="z", forward="x")
    rgb = TracedMesh(mesh).render(view(9.0, 0.0, 0.75)).rgb[36, 48]
    splats = splats_of_mesh(mesh, 500)
    for red, green, blue in (rgb.tolist(), rgb_from_sh(splats.sh[:, 0]).mean(0).tolist()):
        assert green == pytest.approx(blue) and green == pytest.approx(red * 90 / 255, rel=0.1)
