"""Reads mesh files through trimesh: triangles, and how they look, in the frame of an asset."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from PIL import Image

from recon.assets.gltf_mesh import SUFFIXES as GLTF
from recon.assets.gltf_mesh import load_gltf
from recon.assets.mesh_splats import areas, sampled
from recon.assets.obj_mesh import load_obj
from render.tracer import Mesh
from scenes.axes import axis
from scenes.pictures import rgb_of
from scenes.sky import linear_from_srgb, srgb_from_linear

SUFFIXES = (*GLTF, ".obj", ".ply", ".stl", ".off")


def read_mesh(path: Path, up: str = "y", forward: str = "z", scale: float = 1.0) -> Mesh:
    """A mesh file in the frame of an asset: x forward, z up, metres, origin at the base centre of its box.

    up, forward: the file's own axes, as "y", "-z"; glTF's are y and z. ValueError for a file without triangles that can be seen, for
    values that are not finite, and for axes that are not two.
    """
    import trimesh

    if path.is_dir():
        raise ValueError(f"{path} is a folder; give one mesh file of it, as {path / 'car.glb'}")
    if not path.is_file():
        raise FileNotFoundError(f"{path} does not exist")
    try:
        loaded = _loaded(path)
        found: list = list(loaded.dump()) if isinstance(loaded, trimesh.Scene) else [loaded]
    except Exception as problem:  # trimesh's readers raise whatever their formats' libraries do
        why = f"{type(problem).__name__}: {problem}"
        raise ValueError(f"{path} does not read as a mesh ({why}); .glb with its textures inside is best") from None
    parts: list[trimesh.Trimesh] = [p for p in found if isinstance(p, trimesh.Trimesh) and len(p.faces)]
    if not parts:
        raise ValueError(f"{path} holds no triangles")
    if not all(p.faces.min() >= 0 and p.faces.max() < len(p.vertices) for p in parts):
        raise ValueError(f"{path} has triangles of vertices that it does not hold; export it again")
    if not all(np.isfinite(p.vertices).all() for p in parts):
        raise ValueError(f"{path} has vertices that are not finite")
    turn = turn_to_asset(up, forward)
    vertices = [p.vertices @ turn.T * scale for p in parts]
    low, high = np.concatenate(vertices).min(0), np.concatenate(vertices).max(0)
    base = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2]])
    starts = np.cumsum([0, *(len(v) for v in vertices)])
    # copies, as dump makes them, have lost the vertex colours that come on top of a material
    visuals = [loaded.geometry[p.metadata["name"]].visual if isinstance(loaded, trimesh.Scene) else p.visual for p in parts]
    looks = [_look(v, p.faces) for v, p in zip(visuals, parts, strict=True)]
    mesh = Mesh(
        vertices=(np.concatenate(vertices) - base).astype(np.float32),
        faces=np.concatenate([p.faces + s for p, s in zip(parts, starts, strict=False)]).astype(np.int32),
        normals=np.concatenate([(p.vertex_normals @ turn.T)[p.faces] for p in parts]),
        uvs=np.concatenate([uv for uv, _, _ in looks]),
        tints=np.concatenate([tints for _, tints, _ in looks]),
        texture=np.concatenate([np.full(len(p.faces), i) for i, p in enumerate(parts)]),
        textures=tuple(t for _, _, t in looks),
    )
    _check_seen(mesh, path)
    return mesh


def _loaded(path: Path):
    """trimesh's scene, or mesh, of a file."""
    import trimesh

    suffix = path.suffix.lower()
    return load_gltf(path) if suffix in GLTF else load_obj(path) if suffix == ".obj" else trimesh.load(path, process=False)


def _check_seen(mesh: Mesh, path: Path) -> None:
    """ValueError where nothing of a mesh can be seen, or cannot be told."""
    for what, values in {"normals": mesh.normals, "texture coordinates": mesh.uvs, "vertex colours": mesh.tints}.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{path} has {what} that are not finite; export it again, without them or with whole ones")
    if not areas(mesh).any():
        raise ValueError(f"{path} has no triangle of any area; export it again, with its surface")
    if not len(sampled(mesh, 4000)):
        raise ValueError(f"{path} is see-through all over: its materials have no alpha of {mesh.opaque_from} or more; make them opaque")


def turn_to_asset(up: str, forward: str) -> np.ndarray:
    """Rotation `[3, 3]` to x forward, z up from a frame whose own axes those are, as "y" and "-z". ValueError where they are not two."""
    z, x = axis(up, "up"), axis(forward, "forward")
    if abs(x @ z) > 0.5:
        raise ValueError(f"--up {up} and --forward {forward} lie along one axis; give two different ones")
    return np.stack([x, np.cross(z, x), z])


def _look(visual, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of what trimesh says how faces `[F, 3]` look: texture coordinates `[F, 3, 2]` of their corners, v down, tints `[F, 3, 4]` there, and
    the texture uint8 `[H, W, 4]`; one texel where they have one colour."""
    middle, plain = np.full((len(faces), 3, 2), 0.5), np.ones((len(faces), 3, 4))
    white = np.full((1, 1, 4), 255, np.uint8)
    if visual.kind == "texture":
        uv = middle if visual.uv is None else np.asarray(visual.uv)[faces]
        colours = visual.vertex_attributes.get("color")  # glTF's alone
        tints = plain if colours is None else _tints(np.asarray(colours)[faces], linear=True, opaque=_is_opaque(visual.material))
        return np.stack([uv[..., 0], 1 - uv[..., 1]], -1), tints, _texture(visual.material)
    if visual.kind == "vertex":
        return middle, _tints(np.asarray(visual.vertex_colors)[faces], linear=False, opaque=False), white
    if visual.kind == "face":
        return middle, _tints(np.repeat(np.asarray(visual.face_colors)[:, None], 3, 1), linear=False, opaque=False), white
    return middle, plain, np.array([[[180, 180, 180, 255]]], np.uint8)


def _tints(colours: np.ndarray, linear: bool, opaque: bool) -> np.ndarray:
    """Display-referred tints rgba `[F, 3, 4]` of colours `[F, 3, 3 or 4]` of corners, in linear light or not, of whole numbers or 0..1."""
    most = np.iinfo(colours.dtype).max if colours.dtype.kind in "iu" else 1.0
    rgba = np.ones((*colours.shape[:2], 4))
    rgba[..., : colours.shape[2]] = colours / most
    if opaque:
        rgba[..., 3] = 1
    if linear:
        rgba[..., :3] = srgb_from_linear(torch.from_numpy(rgba[..., :3])).numpy()
    return rgba


def _is_opaque(material) -> bool:
    return getattr(material, "alphaMode", None) in (None, "OPAQUE")


def _texture(material) -> np.ndarray:
    """The texture uint8 `[H, W, 4]` of a trimesh material: its picture, white without one, times its factor, which glTF has in linear
    light; of the simple materials of other formats the picture, or else their colour."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    factor = getattr(material, "baseColorFactor", None)
    if image is None and not hasattr(material, "baseColorFactor"):
        return np.asarray(material.main_color, np.uint8).reshape(1, 1, 4)
    texture = np.full((1, 1, 4), 255, np.uint8) if image is None else np.asarray(_rgba(image)).copy()
    if factor is not None and (np.asarray(factor) != 255).any():
        share = torch.from_numpy(np.asarray(factor, np.float32) / 255)
        rgba = torch.from_numpy(texture).float() / 255
        lit = srgb_from_linear(linear_from_srgb(rgba[..., :3]) * share[:3])
        texture = (torch.cat([lit, rgba[..., 3:] * share[3]], -1) * 255).round().to(torch.uint8).numpy()
    if _is_opaque(material):
        texture[..., 3] = 255
    return texture


def _rgba(image: Image.Image) -> Image.Image:
    """A texture as 8-bit RGBA; grey of 16 bits is scaled (`rgb_of`)."""
    return (rgb_of(image) if image.mode.startswith("I") else image).convert("RGBA")
