"""A small made-up street for tests: a road with a kerb and a dashed line, houses, a moving car, a sky, two cameras."""

import math
from dataclasses import replace

import torch

from scenes import Actor, Asset, Gaussians, Ground, Pinhole, Placed, RigCamera, Scene, Sky, Trajectory
from scenes.harmonics import sh_from_rgb
from scenes.poses import pose_from, translation

START_US = 1_500_000_000_000_000  # a real log's clock: microseconds since 1970 do not fit float32
STEP_US = 100_000


def splats(points, colours, scales, opacity=0.95) -> Gaussians:
    """Axis-aligned splats: points `[N, 3]`, colours `[N, 3]` or `[3]`, scales `[N, 3]` or `[3]` in metres."""
    points = torch.as_tensor(points, dtype=torch.float32)
    n = len(points)
    colours = torch.as_tensor(colours, dtype=torch.float32).expand(n, 3)
    scales = torch.as_tensor(scales, dtype=torch.float32).expand(n, 3)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1)
    return Gaussians(points, quats, scales.log(), torch.full((n,), math.log(opacity / (1 - opacity))), sh_from_rgb(colours)[:, None])


def box(size, colour, step=0.2) -> Gaussians:
    """The surface of a box `[length, width, height]` on the ground, its base centre at the origin, its nose (x+) paler."""
    axes = [torch.linspace(-s / 2, s / 2, max(2, round(s / step) + 1)) for s in size]
    grid = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    edge = torch.tensor(size) / 2
    grid = grid[((grid.abs() - edge).abs() < 1e-4).any(1)]
    shade = 0.75 + 0.25 * grid[:, 2:] / edge[2] + 0.3 * (grid[:, :1] > edge[0] - 1e-3)
    return splats(grid + torch.tensor([0.0, 0.0, size[2] / 2]), (torch.tensor(colour) * shade).clamp(0, 1), (step * 0.6,) * 3)


def car(label="car", colour=(0.8, 0.15, 0.1)) -> Asset:
    """A box of a car's size."""
    size = (4.2, 1.8, 1.5)
    return Asset(box(size, colour), size, label, meta={"licence": "CC0-1.0", "views": 3, "source": "made for tests"})


def road(length=60.0) -> Gaussians:
    """A flat road along x at z = 0: asphalt to |y| < 5, paler pavements beyond, dashes along y = 0, houses on both sides."""
    x, y = torch.meshgrid(torch.arange(-10.0, length, 0.5), torch.arange(-9.0, 9.01, 0.5), indexing="ij")
    points = torch.stack([x, y, torch.zeros_like(x)], -1).reshape(-1, 3)
    grey = torch.where(points[:, 1:2].abs() < 5, 0.32, 0.55) + 0.04 * torch.sin(points[:, :1] * 9) * torch.cos(points[:, 1:2] * 7)
    ground = splats(points, grey.expand(-1, 3), (0.4, 0.4, 0.02))
    dash = torch.arange(-10.0, length, 0.25)
    dash = dash[(dash % 4) < 2]
    line = splats(torch.stack([dash, torch.zeros_like(dash), torch.full_like(dash, 0.02)], -1), (0.9, 0.9, 0.85), (0.15, 0.08, 0.02))
    colours = [(0.6, 0.4, 0.3), (0.5, 0.55, 0.6), (0.65, 0.6, 0.4)]
    houses = []
    for i, x0 in enumerate(range(0, int(length), 9)):
        for side in (-1, 1):
            house = box((7.0, 3.0, 5.0 + i % 3), colours[(i + (side > 0)) % 3], step=0.6)
            offset = torch.tensor([x0 + 3.0, side * 10.0, 0.0])
            houses.append(replace(house, means=house.means + offset))
    return Gaussians.cat([ground, line, *houses])


def sky(height=16) -> Sky:
    """Blue above, pale at the horizon, grey below."""
    v = torch.linspace(1, -1, height)[:, None, None]
    blue, pale, below = torch.tensor([0.12, 0.3, 0.75]), torch.tensor([0.75, 0.8, 0.85]), torch.tensor([0.2, 0.2, 0.2])
    rows = torch.where(v > 0, pale + (blue - pale) * v, below)
    return Sky(rows.expand(height, 2 * height, 3).contiguous().to(torch.float32))


def rig(width=96, height=54) -> dict[str, RigCamera]:
    """A front camera and a left one, 1.5 m above the ground."""
    flu_from_cam = torch.tensor([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]], dtype=torch.float64)
    forward = torch.eye(4, dtype=torch.float64)
    forward[:3, :3] = flu_from_cam
    left = pose_from([math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8)], [0.0, 0.0, 0.0]) @ forward
    times = START_US + STEP_US * torch.arange(8)
    lens = Pinhole(width * 0.6, width * 0.6, width / 2, height / 2)
    up = translation(1.0, 0.0, 1.5)
    return {
        "front_camera": RigCamera(lens, width, height, up @ forward, times_us=times),
        "left_camera": RigCamera(lens, width, height, up @ left, times_us=times + 20_000),
    }


def street() -> Scene:
    """Eight frames at 10 Hz along x at 5 m/s; `veh_1` comes the other way; the ground is z = 0."""
    times = START_US + STEP_US * torch.arange(9)
    ego = torch.stack([translation(0.5 * i, 0.0, 0.0) for i in range(9)])
    turned = pose_from([0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0])
    oncoming = torch.stack([translation(22 - 0.8 * i, 2.5, 0.0) @ turned for i in range(9)])
    return Scene(
        background=Placed(road(), torch.eye(4, dtype=torch.float64)),
        actors=(Actor(car(colour=(0.1, 0.3, 0.8)), Trajectory(times, oncoming), "veh_1"),),
        sky=sky(),
        ego=Trajectory(times, ego),
        rig=rig(),
        ground=Ground(torch.zeros(40, 60), (-10.0, -20.0), 1.0),
        meta={"name": "street", "source": "made for tests", "licence": "CC0-1.0"},
    )
