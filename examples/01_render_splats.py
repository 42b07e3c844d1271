"""Splats and a camera become a picture: a ring of coloured Gaussians, seen from above its rim."""

import math
from pathlib import Path

import torch
import tyro

from render import rasterize
from render.video import write_image
from scenes import Camera, Gaussians, Pinhole
from scenes.harmonics import sh_from_rgb


def ring(count: int = 400) -> Gaussians:
    """Splats on a circle of 2 m in the xy plane, each a flat disc, coloured by its angle."""
    angle = torch.linspace(0, 2 * math.pi, count + 1)[:-1]
    means = torch.stack([2 * angle.cos(), 2 * angle.sin(), 0.3 * (6 * angle).sin()], 1)
    colours = torch.stack([0.5 + 0.5 * (angle + shift).cos() for shift in (0.0, 2.1, 4.2)], 1)
    quats = torch.stack([(angle / 2).cos(), 0 * angle, 0 * angle, (angle / 2).sin()], 1)  # wxyz: turned about z
    log_scales = torch.tensor([0.03, 0.12, 0.12]).log().expand(count, 3)
    return Gaussians(means, quats, log_scales, torch.full((count,), 2.0), sh_from_rgb(colours)[:, None])


def camera(width: int = 640, height: int = 360) -> Camera:
    """5 m back and 3 m up, looking at the origin; camera axes are right, down, forward."""
    position = torch.tensor([-5.0, 0.0, 3.0], dtype=torch.float64)
    forward = -position / position.norm()
    right = torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64)
    world_from_cam = torch.eye(4, dtype=torch.float64)
    world_from_cam[:3, :3] = torch.stack([right, torch.linalg.cross(forward, right), forward], 1)
    world_from_cam[:3, 3] = position
    return Camera(Pinhole(500.0, 500.0, width / 2, height / 2), width, height, world_from_cam)


def main(output: Path = Path("ring.png")) -> None:
    """Render the ring. Gradients flow to every field: here, to what would make the picture brighter."""
    splats = ring().map(lambda t: t.clone().requires_grad_())
    frame = rasterize(splats, camera(), outputs=("rgb", "depth"), background=torch.tensor([0.08, 0.09, 0.1]))
    frame.rgb.mean().backward()
    write_image(output, frame.rgb)
    near, far = frame.depth[frame.depth.isfinite()].aminmax()
    print(f"wrote {output}; depth {near:.2f} to {far:.2f} m; largest opacity gradient {splats.logit_opacities.grad.abs().max():.2e}")


if __name__ == "__main__":
    tyro.cli(main)
