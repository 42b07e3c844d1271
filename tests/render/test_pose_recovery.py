"""Lost poses are found again from the picture alone: what pose gradients are for."""

import math
from dataclasses import replace

import pytest
import torch

from render import rasterize
from scenes import Camera, Fisheye, Pinhole, Placed
from scenes.poses import inverse, matrix_from_quat, pose_from, translation
from tests.bench.presets import random_splats

LEVELS = ((20, 14), (40, 28), (80, 56), (160, 112))
STEPS = 40
HERE = pose_from([1, 0.02, -0.03, 0.01], [0.2, -0.1, 0.0])


def lost(metres: float, degrees: float, seed: int) -> torch.Tensor:
    """A pose off by exactly so much, in a random direction, about a random axis."""
    axis, way = torch.nn.functional.normalize(torch.randn(2, 3, generator=torch.Generator().manual_seed(seed)).double(), dim=1)
    half = math.radians(degrees) / 2
    return pose_from(torch.cat([torch.tensor([math.cos(half)]).double(), math.sin(half) * axis]), metres * way)


def moved(change: torch.Tensor) -> torch.Tensor:
    """The pose of a small change `[6]`: half a rotation vector, metres."""
    quat = torch.cat([torch.ones(1, dtype=torch.float64), change[:3]])
    top = torch.cat([matrix_from_quat(quat), change[3:, None]], 1)
    return torch.cat([top, torch.eye(4, dtype=torch.float64)[3:]])


def scene() -> list[Placed]:
    wide = random_splats(500, 0, sh_count=4)
    wide = replace(wide, means=wide.means * torch.tensor([2.0, 1.5, 1.2]), log_scales=wide.log_scales + 0.3)
    car = random_splats(120, 1, sh_count=4, spread=0.6)
    pose = pose_from([0.9, 0.1, 0.3, -0.1], [0.4, 0.1, 4.5])
    return [Placed(wide, translation(0, 0, 9)), Placed(car, pose, instance=1)]


def off(found: torch.Tensor, true: torch.Tensor) -> tuple[float, float]:
    """Metres and degrees between two poses."""
    between = inverse(true) @ found
    angle = math.acos(min(1.0, (float(between[:3, :3].diagonal().sum()) - 1) / 2))
    return float(between[:3, 3].norm()), math.degrees(angle)


def recover(draw, camera: Camera, start: torch.Tensor) -> torch.Tensor:
    """The pose whose picture `draw(pose, camera)` is that of `draw(None, camera)`: Adam on the mean square, coarse to fine."""
    change = torch.zeros(6, dtype=torch.float64, requires_grad=True)
    for level, (width, height) in enumerate(LEVELS):
        view = camera.resized(width, height)
        with torch.no_grad():
            photo = draw(None, view)
        fit = torch.optim.Adam([change], lr=0.02 / 2**level, betas=(0.8, 0.98))
        decay = torch.optim.lr_scheduler.CosineAnnealingLR(fit, STEPS, 0.001 / 2**level)
        for _ in range(STEPS):
            fit.zero_grad()
            pose = start @ moved(change * torch.tensor([0.3] * 3 + [2.0] * 3))
            (draw(pose, view) - photo).square().mean().backward()
            fit.step()
            decay.step()
    return pose.detach()


@pytest.mark.parametrize("lens", [Pinhole(130.0, 130.0, 80.0, 56.0), Fisheye(110.0, 110.0, 80.0, 56.0, -0.02)], ids=["pinhole", "fisheye"])
def test_a_camera_off_by_half_a_metre_and_three_degrees_is_found_again(lens):
    placed, camera = scene(), Camera(lens, 160, 112, HERE)

    def draw(pose, view):
        return rasterize(placed, view if pose is None else replace(view, world_from_cam=pose)).rgb

    start = HERE @ lost(0.5, 3, 2)
    assert off(start, HERE) == pytest.approx((0.5, 3.0))
    metres, degrees = off(recover(draw, camera, start), HERE)
    assert metres < 0.02 and degrees < 0.1, f"left: {metres:.4f} m, {degrees:.3f} degrees"


def test_an_actor_off_by_half_a_metre_and_five_degrees_is_found_again():
    (street, car), camera = scene(), Camera(Pinhole(130.0, 130.0, 80.0, 56.0), 160, 112, HERE)

    def draw(pose, view):
        return rasterize([street, car if pose is None else replace(car, world_from_local=pose)], view).rgb

    true = car.world_from_local
    start = true @ lost(0.5, 5, 3)
    found = recover(draw, camera, start)
    metres, degrees = off(found, true)
    assert metres < 0.02 and degrees < 0.1, f"left: {metres:.4f} m, {degrees:.3f} degrees"


def test_both_ends_of_a_moving_shutter_are_found_again():
    """The camera's pose at the first row is known; that at the last, off by 0.5 m and 3 degrees, is found from one picture."""
    placed = scene()
    end = HERE @ lost(0.8, 2, 5)
    camera = Camera(Pinhole(130.0, 130.0, 80.0, 56.0), 160, 112, HERE, end, shutter="rows")

    def draw(pose, view):
        return rasterize(placed, view if pose is None else replace(view, world_from_cam_end=pose)).rgb

    metres, degrees = off(recover(draw, camera, end @ lost(0.5, 3, 4)), end)
    assert metres < 0.02 and degrees < 0.1, f"left: {metres:.4f} m, {degrees:.3f} degrees"
