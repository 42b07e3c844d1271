"""A textured mesh becomes a splat asset: its surface is sampled, and a short fit makes the splats look as the traced mesh does."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from recon.assets.gltf_mesh import SUFFIXES as GLTF
from recon.assets.gltf_mesh import load_gltf
from recon.assets.looking import looking_at
from render import Frame, rasterize
from render.compare import decibels
from render.tracer import SKY, Blockers, Mesh, TracedMesh, fibonacci, lit
from scenes.asset import Asset
from scenes.axes import axis
from scenes.camera import Camera
from scenes.gaussians import Gaussians, SplatModel
from scenes.harmonics import sh_from_rgb
from scenes.match import ASPHALT
from scenes.pictures import rgb_of
from scenes.poses import matrix_from_quat, quat_from_matrix
from scenes.sky import linear_from_srgb, srgb_from_linear

SUFFIXES = (*GLTF, ".obj", ".ply", ".stl", ".off")
MODEL = SplatModel(projection="ewa")


@dataclass(frozen=True)
class MeshFit:
    """How a mesh becomes splats."""

    splats: int = 30_000
    """Samples of the surface."""
    views: int = 72
    """Traced pictures that the splats are fitted to."""
    steps: int = 700
    """Pictures compared."""
    size: tuple[int, int] = (320, 240)
    """Of the pictures, in pixels."""
    seed: int = 0
    """Of the order of the pictures."""


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
        loaded = load_gltf(path) if path.suffix.lower() in GLTF else trimesh.load(path, process=False)
    except Exception as problem:  # trimesh's readers raise whatever their formats' libraries do
        why = f"{type(problem).__name__}: {problem}"
        raise ValueError(f"{path} does not read as a mesh ({why}); .glb with its textures inside is best") from None
    found: list = list(loaded.dump()) if isinstance(loaded, trimesh.Scene) else [loaded]
    parts: list[trimesh.Trimesh] = [p for p in found if isinstance(p, trimesh.Trimesh) and len(p.faces)]
    if not parts:
        raise ValueError(f"{path} holds no triangles")
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


def _check_seen(mesh: Mesh, path: Path) -> None:
    """ValueError where nothing of a mesh can be seen, or cannot be told."""
    for what, values in {"normals": mesh.normals, "texture coordinates": mesh.uvs, "vertex colours": mesh.tints}.items():
        if not np.isfinite(values).all():
            raise ValueError(f"{path} has {what} that are not finite; export it again, without them or with whole ones")
    if not _areas(mesh).any():
        raise ValueError(f"{path} has no triangle of any area; export it again, with its surface")
    if not len(_sampled(mesh, 4000)):
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


def splats_of_mesh(mesh: Mesh, count: int) -> Gaussians:
    """About `count` splats on what can be seen of a mesh: as dense everywhere, flat on their triangles, coloured as under an even sky."""
    blockers = Blockers(mesh.vertices[mesh.faces])
    share = float(_in_the_open(_sampled(mesh, 4000), blockers).sum()) / 4000
    splats = _sampled(mesh, round(count / max(share, 0.2)))
    return splats.select(_in_the_open(splats, blockers))


def _in_the_open(splats: Gaussians, blockers: Blockers) -> torch.Tensor:
    """Mask `[N]` of flat splats that see something of the outside on either of their faces: seats and the insides of doors do not."""
    normals = matrix_from_quat(splats.quats)[:, :, 2]
    around = fibonacci(64)
    sides = [blockers.open_share(splats.means + side * 0.004 * normals, around, torch.ones(64), 100.0) for side in (1, -1)]
    return (sides[0] > 0.01) | (sides[1] > 0.01)


def _areas(mesh: Mesh) -> np.ndarray:
    """Square metres `[F]` of a mesh's faces."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    return np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2


def _sampled(mesh: Mesh, count: int) -> Gaussians:
    """Splats evenly over all of a mesh's surface that is not see-through."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    cross = np.cross(a, b)
    ends = np.cumsum(_areas(mesh))
    # even steps along the area, and within a triangle the R2 sequence (Roberts 2018): as even as random, without its clumps
    face = np.searchsorted(ends, (np.arange(count) + 0.5) / count * ends[-1]).clip(0, len(ends) - 1)
    u, v = np.modf(np.arange(count) * 0.7548776662466927)[0], np.modf(np.arange(count) * 0.5698402909980532)[0]
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    weights = np.stack([1 - u - v, u, v], 1)[..., None]
    means = (corners[face] * weights).sum(1)
    normals = (mesh.normals[face] * weights).sum(1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-9)
    colours = _texels(mesh, face, (mesh.uvs[face] * weights).sum(1)) * (mesh.tints[face] * weights).sum(1)
    solid = colours[:, 3] >= mesh.opaque_from
    flat = cross[face] / np.linalg.norm(cross[face], axis=1, keepdims=True).clip(1e-12)
    axis = a[face] / np.linalg.norm(a[face], axis=1, keepdims=True).clip(1e-12)
    frame = torch.from_numpy(np.stack([axis, np.cross(flat, axis), flat], 2))
    spacing = math.sqrt(ends[-1] / count)
    keep = torch.from_numpy(solid)
    rgb = lit(torch.from_numpy(colours[:, :3]).float(), torch.from_numpy(normals).float())
    scales = torch.tensor([0.6 * spacing, 0.6 * spacing, 0.08 * spacing]).log().repeat(count, 1)
    whole = Gaussians(
        torch.from_numpy(means).float(), quat_from_matrix(frame).float(), scales, torch.full((count,), 2.0), sh_from_rgb(rgb)[:, None]
    )
    return whole.select(keep)


def _texels(mesh: Mesh, face: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Colours rgba `[N, 4]` in 0..1 at texture coordinates `[N, 2]` of faces `[N]`: the nearest texel."""
    out = np.zeros((len(face), 4))
    for i, texture in enumerate(mesh.textures):
        own = mesh.texture[face] == i
        h, w = texture.shape[:2]
        column, row = (np.floor(uv[own] * [w, h]).astype(np.int64) % [w, h]).T
        out[own] = texture[row, column] / 255
    return out


def views_around(size: np.ndarray, count: int, pixels: tuple[int, int], offset: float = 0.0) -> list[Camera]:
    """Cameras on a spiral, from `offset` on, around a box `[length, width, height]`, from just below its middle to above."""
    centre = torch.tensor([0.0, 0.0, float(size[2]) / 2], dtype=torch.float64)
    distance = 1.75 * 2.0 * float(np.linalg.norm(size)) / 2 * 1.04
    cameras = []
    for i in range(count):
        t = (i + 0.5 + offset) / (count + 1)
        rise = -0.08 + 1.0 * t  # sine of the elevation, so that the views are spread evenly
        azimuth = (i + offset) * 2.399963229728653  # the golden angle
        level = math.sqrt(1 - rise * rise)
        direction = torch.tensor([level * math.cos(azimuth), level * math.sin(azimuth), rise], dtype=torch.float64)
        cameras.append(looking_at(centre, centre + distance * direction, *pixels))
    return cameras


def fit_to_mesh(
    start: Gaussians, traced: TracedMesh, cameras: list[Camera], config: MeshFit, report: Callable[[int, float], None] = lambda *_: None
) -> Gaussians:
    """The splats, moved, turned, resized and recoloured until they look as the traced mesh does to these cameras."""
    targets = [traced.render(c) for c in cameras]
    fields = {name: t.clone().requires_grad_(True) for name, t in start.tensors().items()}
    spacing = float(start.log_scales[:, 0].exp().median())
    rates = {"means": 0.05 * spacing, "quats": 5e-3, "log_scales": 1e-2, "logit_opacities": 4e-2, "sh": 1e-2}
    adam = torch.optim.Adam([{"params": [fields[k]], "lr": rate} for k, rate in rates.items()], betas=(0.9, 0.99), eps=1e-12, fused=True)
    dice = torch.Generator().manual_seed(config.seed)
    order = torch.cat([torch.randperm(len(cameras), generator=dice) for _ in range(-(-config.steps // len(cameras)))])[: config.steps]
    for step, i in enumerate(order.tolist()):
        for group, rate in zip(adam.param_groups, rates.values(), strict=True):
            group["lr"] = rate * 0.05 ** (step / config.steps)
        frame, target = _drawn(Gaussians(**fields), cameras[i]), targets[i]
        assert frame.rgb is not None and frame.alpha is not None and target.rgb is not None and target.alpha is not None
        # over a colour of its own each time, so that what should be opaque cannot borrow the background's
        backdrop = torch.rand(3, generator=dice)
        ours = frame.rgb + (1 - frame.alpha)[..., None] * backdrop
        theirs = target.rgb + (1 - target.alpha)[..., None] * backdrop
        error = ours - theirs
        loss = error.square().mean() * 4 + F.l1_loss(ours, theirs)
        loss.backward()
        adam.step()
        adam.zero_grad(set_to_none=True)
        with torch.no_grad():
            fields["log_scales"].clamp_(math.log(spacing) - 4.5, math.log(spacing) + 1.5)
        report(step, float(loss.detach()))
    fitted = Gaussians(**fields).detach()
    return fitted.select(torch.sigmoid(fitted.logit_opacities) > 0.02)


def _drawn(splats: Gaussians, camera: Camera) -> Frame:
    return rasterize(splats, camera, ("rgb", "alpha"), model=MODEL)


def likeness(splats: Gaussians, traced: TracedMesh, cameras: list[Camera]) -> tuple[float, float]:
    """PSNR in dB, of all views' mean squared error, of the splats against the traced mesh over mid-grey: of whole pictures, and of pixels
    that the mesh covers."""
    whole, own = [], []
    for camera in cameras:
        with torch.no_grad():
            ours, theirs = _drawn(splats, camera), traced.render(camera)
        assert ours.rgb is not None and ours.alpha is not None and theirs.rgb is not None and theirs.alpha is not None
        error = (ours.rgb + 0.5 * (1 - ours.alpha)[..., None]).clamp(0, 1) - (theirs.rgb + 0.5 * (1 - theirs.alpha)[..., None])
        whole.append(error.square().mean())
        own.append(error[theirs.alpha > 0].square().mean())
    return decibels(float(torch.stack(whole).mean())), decibels(float(torch.stack(own).mean()))


def asset_of_mesh(
    mesh: Mesh,
    label: str,
    meta: dict,
    config: MeshFit = MeshFit(),
    report: Callable[[int, float], None] = lambda *_: None,  # noqa: B008
) -> Asset:
    """A splat asset that looks as the mesh does; `meta["psnr_unseen"]` says how well, in dB over the mesh's pixels, from 8 new views."""
    size = mesh.vertices.max(0).astype(np.float64) - mesh.vertices.min(0)
    traced = TracedMesh(mesh)
    splats = fit_to_mesh(splats_of_mesh(mesh, config.splats), traced, views_around(size, config.views, config.size), config, report)
    whole, own = likeness(splats, traced, views_around(size, 8, config.size, offset=0.37))
    facts: dict = {"psnr_unseen": round(own, 2), "psnr_unseen_whole_picture": round(whole, 2), "views": config.views}
    facts["ground_linear"] = [ASPHALT * SKY] * 3
    return Asset(splats, torch.from_numpy(np.maximum(size, 1e-3)), label, MODEL, {**meta, **facts})
