"""What places are built of: textured panels, boxes and blobs, and the textures, all from seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy import ndimage

from render.tracer import Mesh

Colour = tuple[float, float, float]
"""Display-referred, 0..1."""


def panel(corner: Sequence[float], along: Sequence[float], up: Sequence[float], texture: np.ndarray, tile: float | None = None) -> Mesh:
    """A rectangle from its lower left corner, metres; `along` x `up` is where it looks. tile: metres that a texture spans, which repeats;
    None for one over all of it."""
    a, u, c = (np.asarray(v, np.float64) for v in (along, up, corner))
    normal = np.cross(a, u)
    normal /= np.linalg.norm(normal)
    across, high = (np.linalg.norm(a) / tile, np.linalg.norm(u) / tile) if tile else (1.0, 1.0)
    uvs = np.array([[0, high], [across, high], [across, 0], [0, 0]])
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    return Mesh(
        vertices=np.stack([c, c + a, c + a + u, c + u]).astype(np.float32),
        faces=faces,
        normals=np.broadcast_to(normal, (2, 3, 3)).astype(np.float32),
        uvs=uvs[faces],
        tints=np.ones((2, 3, 4)),
        texture=np.zeros(2, np.int64),
        textures=(texture,),
    )


def box(at: Sequence[float], size: Sequence[float], texture: np.ndarray, tile: float | None = None, top: np.ndarray | None = None) -> Mesh:
    """A box over the base centre `at`, metres, without its underside; `top` is its upper face's texture if that is another."""
    x, y, z = size
    low = np.asarray(at, np.float64) - [x / 2, y / 2, 0]
    sides = [
        panel(low, (x, 0, 0), (0, 0, z), texture, tile),
        panel(low + [x, 0, 0], (0, y, 0), (0, 0, z), texture, tile),
        panel(low + [x, y, 0], (-x, 0, 0), (0, 0, z), texture, tile),
        panel(low + [0, y, 0], (0, -y, 0), (0, 0, z), texture, tile),
    ]
    return joined([*sides, panel(low + [0, 0, z], (x, 0, 0), (0, y, 0), texture if top is None else top, tile)])


def blob(at: Sequence[float], radii: Sequence[float], texture: np.ndarray, rings: int = 8) -> Mesh:
    """An ellipsoid around `at`, radii in metres."""
    polar, azimuth = np.linspace(0, np.pi, rings + 1), np.linspace(0, 2 * np.pi, 2 * rings + 1)
    p, a = np.meshgrid(polar, azimuth, indexing="ij")
    unit = np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], -1).reshape(-1, 3)
    uv = np.stack([a / (2 * np.pi), p / np.pi], -1).reshape(-1, 2)
    i, j = (v.ravel() for v in np.meshgrid(np.arange(rings), np.arange(2 * rings), indexing="ij"))
    first, below = i * (2 * rings + 1) + j, (i + 1) * (2 * rings + 1) + j
    faces = np.concatenate([np.stack([first, below, below + 1], 1), np.stack([first, below + 1, first + 1], 1)]).astype(np.int32)
    normals = unit / np.asarray(radii)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = len(faces)
    return Mesh(
        vertices=(unit * radii + np.asarray(at)).astype(np.float32),
        faces=faces,
        normals=normals[faces].astype(np.float32),
        uvs=uv[faces],
        tints=np.ones((count, 3, 4)),
        texture=np.zeros(count, np.int64),
        textures=(texture,),
    )


def crown(
    chance: np.random.Generator, middle: Sequence[float], size: float, blobs: int, radii: tuple[float, float], leaves: np.ndarray
) -> list[Mesh]:
    """A tree's blobs within 0.9 m of its middle along each axis, of radii between two; all `size` times as large."""
    return [blob(chance.uniform(-0.9, 0.9, 3) * size + middle, chance.uniform(*radii, 3) * size, leaves, 6) for _ in range(blobs)]


def moved(mesh: Mesh, at: Sequence[float], yaw: float = 0.0) -> Mesh:
    """Turned about z by `yaw` radians, then moved."""
    pose = np.eye(4)
    pose[:2, :2], pose[:3, 3] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]], at
    return posed(mesh, pose)


def posed(mesh: Mesh, pose: np.ndarray) -> Mesh:
    """Moved rigidly by world_from_mesh `[4, 4]`."""
    turn = pose[:3, :3]
    return replace(mesh, vertices=(mesh.vertices @ turn.T + pose[:3, 3]).astype(np.float32), normals=mesh.normals @ turn.T)


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """All of them as one; textures that are the same are kept once."""
    textures: dict[int, int] = {}
    kept: list[np.ndarray] = []
    for mesh in meshes:
        for texture in mesh.textures:
            if id(texture) not in textures:
                textures[id(texture)] = len(kept)
                kept.append(texture)
    first = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + f for m, f in zip(meshes, first, strict=False)]).astype(np.int32),
        normals=np.concatenate([m.normals for m in meshes]),
        uvs=np.concatenate([m.uvs for m in meshes]),
        tints=np.concatenate([m.tints for m in meshes]),
        texture=np.concatenate([np.array([textures[id(t)] for t in m.textures])[m.texture] for m in meshes]),
        textures=tuple(kept),
    )


def painted(rgb: np.ndarray) -> np.ndarray:
    """A texture uint8 `[H, W, 4]` of colours `[H, W, 3]`, 0..1."""
    opaque = np.ones((*rgb.shape[:2], 1))
    return (255 * np.concatenate([rgb.clip(0, 1), opaque], -1)).round().astype(np.uint8)


def plain(colour: Colour) -> np.ndarray:
    return painted(np.full((1, 1, 3), colour))


def grain(seed: int, colour: Colour, contrast: float = 0.15, pixels: int = 256) -> np.ndarray:
    """Something rough that repeats without a seam: noise of several sizes, brighter and darker than `colour`."""
    chance = np.random.default_rng(seed)
    noise = np.zeros((pixels, pixels))
    for blur in (0.8, 2.0, 6.0, 20.0):
        layer = ndimage.gaussian_filter(chance.normal(size=noise.shape), blur, mode="wrap")
        noise += layer / layer.std()
    return painted(np.asarray(colour) * (1 + contrast * noise[..., None] / 2))


def facade(seed: int, colour: Colour, pixels: int = 160) -> np.ndarray:
    """One storey's bay of a house: rough plaster and a window with frame, sill and something behind the pane."""
    chance = np.random.default_rng(seed)
    wall = grain(seed, colour, 0.1, pixels)[..., :3] / 255
    left, right = (int(pixels * f) for f in (chance.uniform(0.2, 0.32), chance.uniform(0.66, 0.8)))
    top, foot = (int(pixels * f) for f in (chance.uniform(0.15, 0.25), chance.uniform(0.6, 0.75)))
    frame = max(2, pixels // 40)
    wall[top - frame : foot + frame, left - frame : right + frame] = chance.uniform(0.55, 0.9)
    shade = np.linspace(0.1, 0.3, foot - top)[:, None, None] * chance.uniform(0.6, 1.0, 3)
    wall[top:foot, left:right] = np.broadcast_to(shade, (foot - top, right - left, 3))
    curtain = left + int((right - left) * chance.uniform(0.2, 0.5))
    wall[top:foot, left:curtain] = chance.uniform(0.3, 0.7, 3)
    wall[top:foot, (left + right) // 2 : (left + right) // 2 + frame] = 0.75
    wall[foot + frame : foot + 3 * frame, left - 2 * frame : right + 2 * frame] *= 0.6
    return painted(wall)


def poster(seed: int, pixels: int = 96) -> np.ndarray:
    """Discs and bars of random colours."""
    chance = np.random.default_rng(seed)
    picture = np.broadcast_to(chance.uniform(0.3, 0.9, 3), (pixels, pixels, 3)).copy()
    y, x = np.mgrid[:pixels, :pixels] / pixels
    for _ in range(8):
        cx, cy, r = chance.uniform(0, 1, 2).tolist() + [chance.uniform(0.06, 0.22)]
        disc = (x - cx) ** 2 + (y - cy) ** 2 < r * r
        bar = (abs(x - cx) < r / 4) & (abs(y - cy) < 2 * r)
        picture[disc if chance.random() < 0.5 else bar] = chance.uniform(0, 1, 3)
    return painted(picture)
