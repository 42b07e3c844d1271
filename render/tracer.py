"""Textured triangle meshes, ray-traced: the reference for splats that are made of them, and what casts shadows."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch
import warp as wp

from render.frame_types import Frame
from render.kernels.trace import Surface, trace_surface, visible
from render.launch import run, stage, view
from render.rays import camera_rays
from scenes.camera import Camera
from scenes.sky import linear_from_srgb, srgb_from_linear

SAMPLES = 3
"""Rays a pixel, along each side of it."""

SKY, GROUND = 1.0, 0.3
"""Radiance of the sky and of the ground that light a traced mesh."""

CPU = torch.device("cpu")


@dataclass(frozen=True)
class Mesh:
    """F textured triangles: vertices float32 `[V, 3]` metres, faces int32 `[F, 3]`; of each face's corners unit normals `[F, 3, 3]`,
    texture coordinates `[F, 3, 2]` (u right, v down, in textures) and tints `[F, 3, 4]`, which multiply the texture; texture `[F]` index
    into textures uint8 `[H, W, 4]`. Both are sRGB and alpha: of what is nearly a power the products are nearly those of linear light."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    tints: np.ndarray
    texture: np.ndarray
    textures: tuple[np.ndarray, ...]
    opaque_from: float = 0.5


class Blockers:
    """Triangles `[F, 3, 3]` in metres as what stands in the way of light."""

    def __init__(self, triangles: np.ndarray):
        corners = np.ascontiguousarray(triangles, np.float32).reshape(-1, 3)
        index = np.arange(len(corners), dtype=np.int32)
        self.mesh = wp.Mesh(wp.array(corners, dtype=wp.vec3, device="cpu"), wp.array(index, dtype=wp.int32, device="cpu"))

    def open_share(self, points: torch.Tensor, directions: torch.Tensor, weights: torch.Tensor, reach: float) -> torch.Tensor:
        """The part `[N]` of light from unit `directions` `[K, 3]` with `weights` `[K]` that reaches points `[N, 3]`: 1 in the open."""
        out = torch.zeros(len(points), dtype=torch.float32)
        points, directions, weights = (t.detach().float().contiguous() for t in (points, directions, weights))
        with stage(CPU):
            arrays = view(points, wp.vec3), view(directions, wp.vec3), reach, view(weights, float), view(out, float)
            run(visible, len(points), [self.mesh.id, *arrays], CPU)
        return out / weights.sum()


@dataclass(frozen=True)
class TracedMesh:
    """A mesh ready to be traced, on the CPU."""

    mesh: Mesh
    _kept: list = field(default_factory=list, repr=False)

    def __post_init__(self):
        m, sizes = self.mesh, [t.shape[:2] for t in self.mesh.textures]
        first = np.cumsum([0, *(h * w for h, w in sizes)])[:-1]
        tensors = {
            "normals": torch.from_numpy(m.normals.astype(np.float32).reshape(-1, 3)),
            "uvs": torch.from_numpy(m.uvs.astype(np.float32).reshape(-1, 2)),
            "tints": torch.from_numpy(m.tints.astype(np.float32).reshape(-1, 4)),
            "texture": torch.from_numpy(m.texture.astype(np.int32)),
            "first": torch.from_numpy(first.astype(np.int32)),
            "width": torch.tensor([w for _, w in sizes], dtype=torch.int32),
            "height": torch.tensor([h for h, _ in sizes], dtype=torch.int32),
            "texels": torch.from_numpy(np.concatenate([t.reshape(-1, 4) for t in m.textures]).astype(np.float32) / 255),
        }
        types = {"normals": wp.vec3, "uvs": wp.vec2, "tints": wp.vec4, "texels": wp.vec4}
        surface = Surface()
        for name, tensor in tensors.items():
            setattr(surface, name, wp.from_torch(tensor.contiguous(), dtype=types.get(name, wp.int32)))
        points = wp.array(m.vertices.astype(np.float32), dtype=wp.vec3, device="cpu")
        warp_mesh = wp.Mesh(points, wp.array(m.faces.astype(np.int32).reshape(-1), dtype=wp.int32, device="cpu"))
        self._kept.extend([surface, tensors, warp_mesh])

    def trace(self, origins: torch.Tensor, directions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Along rays `[N, 3]` of any length: albedo rgba `[N, 4]` (sRGB; alpha 1 or 0), normal towards the viewer `[N, 3]`, and distance
        `[N]` in metres, inf for a miss."""
        n = len(origins)
        colours, normals, distances = (torch.empty(shape, dtype=torch.float32) for shape in ((n, 4), (n, 3), (n,)))
        rays = [t.detach().float().contiguous() for t in (origins, directions)]
        surface, _, mesh = self._kept
        with stage(CPU):
            arrays = [view(t, wp.vec3) for t in rays] + [view(colours, wp.vec4), view(normals, wp.vec3), view(distances, float)]
            run(trace_surface, n, [mesh.id, surface, self.mesh.opaque_from, *arrays], CPU)
        return colours, normals, distances

    def render(self, camera: Camera, samples: int = SAMPLES) -> Frame:
        """The mesh as a camera sees it: rgb premultiplied over black, and alpha, averaged over `samples` x `samples` rays a pixel."""
        fine = camera.resized(camera.width * samples, camera.height * samples)
        pose = camera.world_from_cam.detach().float()
        directions = camera_rays(fine).reshape(-1, 3) @ pose[:3, :3].T
        colours, normals, _ = self.trace(pose[:3, 3].expand(len(directions), 3), directions)
        picture = torch.cat([lit(colours[:, :3], normals) * colours[:, 3:], colours[:, 3:]], 1)
        fine_picture = picture.T.reshape(1, 4, fine.height, fine.width)
        small = torch.nn.functional.avg_pool2d(fine_picture, samples)[0]
        return Frame(camera, rgb=small[:3].permute(1, 2, 0).contiguous(), alpha=small[3])


def lit(albedo: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """Display-referred colours `[N, 3]` of sRGB albedo `[N, 3]` under an even sky over an even ground.

    The irradiance of two half-spheres of constant radiance on a surface of normal n is pi ((1 + n_z) / 2 sky + (1 - n_z) / 2 ground);
    nothing shades anything, so that an asset brings no light of its own but what every street has.
    """
    up = normals[:, 2:]
    return srgb_from_linear(linear_from_srgb(albedo) * (SKY * (1 + up) / 2 + GROUND * (1 - up) / 2))


def fibonacci(count: int) -> torch.Tensor:
    """`count` unit directions `[K, 3]` evenly around the sphere, from the top down (the Fibonacci lattice)."""
    i = torch.arange(count, dtype=torch.float64) + 0.5
    z = 1 - 2 * i / count
    azimuth = i * 2.399963229728653  # the golden angle
    level = (1 - z * z).sqrt()
    return torch.stack([level * azimuth.cos(), level * azimuth.sin(), z], 1).float()
