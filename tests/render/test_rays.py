"""Response "ray" and order "pixel": against the float64 oracle, and what each is for."""

import math
from dataclasses import replace

import pytest
import torch

from render import RenderConfig, rasterize
from scenes import Camera, Gaussians, Pinhole, Placed, SplatModel
from scenes.lenses import Fisheye, Orthographic
from scenes.poses import pose_from, translation
from tests import oracle
from tests.bench.presets import random_splats
from tests.render.test_outputs import leaves
from tests.render.test_rasterize import CAMERA, EXACT, assert_gradient, largest, two_instances

RAY = SplatModel(response="ray")
WAYS = {
    "ray by tile": (RAY, "tile"),
    "ray by pixel": (replace(RAY, projection="ewa", antialias=True), "pixel"),
    "conic by pixel": (SplatModel(), "pixel"),
}
OUTPUTS = ("rgb", "alpha", "depth", "instance")


def small_splats(seed: int) -> list[Placed]:
    """Two instances whose projected ellipses bound their rays' footprint: not too large for their distance."""
    return [replace(p, gaussians=replace(p.gaussians, log_scales=p.gaussians.log_scales - 0.3)) for p in two_instances(seed)]


def tangent(pose: torch.Tensor) -> torch.Tensor:
    """A pose's gradient along what keeps it a pose: `[4, 3]`. Off it a splat's inverse has no one form, and no motion leads there."""
    turn = pose[:3, :3].detach().T @ pose.grad[:3, :3]
    return torch.cat([turn - turn.T, pose.grad[None, :3, 3]])


def assert_near(name: str, mine: torch.Tensor, reference: torch.Tensor) -> None:
    """At twice the tolerance of the tiles' kernels: u x q is a difference of float32 products, where they have a sum of squares."""
    assert_gradient(name, 0.5 * (mine.double() - reference) + reference, reference)


@pytest.mark.parametrize("way", WAYS)
def test_forward_agrees_with_the_oracle(way):
    model, order = WAYS[way]
    placed = small_splats(1)
    rgb, alpha, depth, instance, unsure = oracle.render(
        oracle.as_oracle(placed), CAMERA, model, cutoff=1 / 255, alpha_max=0.999, order=order
    )
    frame = rasterize(placed, CAMERA, OUTPUTS, model=model, config=RenderConfig(termination=0, order=order))
    sure = ~unsure
    assert sure.float().mean() > 0.9
    assert largest(frame.rgb, rgb, sure) < 1e-4 * max(1.0, float(rgb.detach().max()))
    assert largest(frame.alpha, alpha, sure) < 1e-4
    solid = sure & (alpha > 0.01)
    assert largest(frame.depth / depth, torch.ones_like(depth), solid) < 2e-4
    assert (frame.instance != instance)[sure & ((alpha - 0.5).abs() > 1e-4)].float().mean() < 0.002


@pytest.mark.parametrize("way", WAYS)
def test_gradients_agree_with_the_oracle(way):
    model, order = WAYS[way]
    placed = small_splats(2)
    features = [torch.randn(len(p.gaussians), 2, generator=torch.Generator().manual_seed(8)) for p in placed]
    truth = oracle.as_oracle(placed)
    pose, lens = CAMERA.world_from_cam.clone().requires_grad_(), CAMERA.lens.params().requires_grad_()
    rgb, alpha, depth, _, unsure = oracle.render(truth, CAMERA, model, pose, lens, cutoff=1e-8, alpha_max=0.999, order=order)
    generator = torch.Generator().manual_seed(5)
    weights = [torch.randn(*t.shape, generator=generator).double() for t in (rgb, alpha, depth)]
    seen = (alpha > 1e-3) & ~unsure
    weights[0][unsure], weights[1][unsure] = 0, 0

    def loss(rgb, alpha, depth):
        return (rgb * weights[0]).sum() + (alpha * weights[1]).sum() + 0.1 * (depth[seen] * weights[2][seen]).sum()

    loss(rgb, alpha, depth).backward()
    mine = leaves(placed)
    my_pose, my_lens = CAMERA.world_from_cam.clone().requires_grad_(), CAMERA.lens.params().requires_grad_()
    camera = replace(CAMERA, lens=Pinhole(*my_lens), world_from_cam=my_pose)
    config = replace(EXACT, order=order)
    frame = rasterize(mine, camera, (*OUTPUTS, "features"), model=model, config=config, features=features)
    (loss(frame.rgb, frame.alpha, frame.depth) + 0 * frame.features.sum()).backward()
    for i, (p, (fields, world_from_local, _)) in enumerate(zip(mine, truth, strict=True)):
        for name, tensor in p.gaussians.tensors().items():
            assert_near(f"{name} of {i}", tensor.grad, fields[name].grad)
        assert_near(f"pose of {i}", tangent(p.world_from_local), tangent(world_from_local))
    assert_near("camera pose", tangent(my_pose), tangent(pose))
    assert_near("lens", my_lens.grad, lens.grad)


@pytest.mark.parametrize("way", WAYS)
def test_windows_crops_and_features_are_the_same_bits_as_the_whole(way):
    model, order = WAYS[way]
    placed = small_splats(3)
    features = torch.randn(170, 3, generator=torch.Generator().manual_seed(2))
    outputs = (*OUTPUTS, "median_depth", "features", "normal")
    whole = rasterize(placed, CAMERA, outputs, model=model, config=RenderConfig(order=order), features=features)
    config = RenderConfig(order=order, most_entries=150)
    part = rasterize(placed, CAMERA, outputs, model=model, config=config, features=features, crop=(9, 5, 50, 40))
    for name, picture in part.outputs().items():
        assert torch.equal(picture, getattr(whole, name)[5:45, 9:59]), name


def test_order_by_pixel_does_not_depend_on_the_order_of_the_splats():
    g = random_splats(200, 4)
    shuffled = g.select(torch.randperm(200, generator=torch.Generator().manual_seed(0)))
    pictures = [rasterize(Placed(s, translation(0, 0, 5)), CAMERA, config=RenderConfig(order="pixel")).rgb for s in (g, shuffled)]
    assert torch.equal(*pictures)


def test_a_flat_splat_seen_by_rays_is_its_plane_in_perspective():
    """The ground ahead: along its middle line the exponent is that of where each ray meets the plane, which no conic is."""
    ground = Gaussians(
        torch.tensor([[0.0, 1.5, 8.0]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([[math.log(3.0), -9.0, math.log(3.0)]]),
        torch.tensor([2.0]),
        torch.ones(1, 1, 3),
    )
    camera = Camera(Pinhole(60.0, 60.0, 30.0, 10.0), 60, 40, torch.eye(4, dtype=torch.float64))
    alpha = rasterize(ground, camera, ("alpha",), model=RAY).alpha[:, 30]
    down = (torch.arange(40) + 0.5 - 10) / 60
    z = 1.5 / down.clamp_min(1e-6)
    x = z * 0.5 / 60
    expected = torch.sigmoid(torch.tensor(2.0)) * torch.exp(-0.5 * ((z - 8).square() + x.square()) / 9)
    met = (down > 0.12) & (expected > 0.02)
    assert met.sum() > 10 and (alpha - expected)[met].abs().max() < 1e-3


def test_a_fisheye_is_drawn_by_rays_as_the_oracle_has_it():
    camera = Camera(Fisheye(24.0, 24.0, 32.0, 24.0, k1=0.02), 64, 48, torch.eye(4, dtype=torch.float64))
    g = random_splats(60, 5)
    placed = [Placed(replace(g, log_scales=g.log_scales - 0.5), translation(0, 0, 4))]
    rgb, alpha, _, _, unsure = oracle.render(oracle.as_oracle(placed), camera, RAY, cutoff=1 / 255, alpha_max=0.999)
    frame = rasterize(placed, camera, model=RAY, config=RenderConfig(termination=0))
    assert largest(frame.rgb, rgb, ~unsure) < 1e-4 * max(1.0, float(rgb.detach().max()))


def test_turning_the_camera_pops_less_by_pixel_than_by_tile():
    from tests.bench.popping import largest_steps

    by_tile, by_pixel = largest_steps(splats=150, steps=30)
    assert by_pixel < 0.05 and by_pixel < 0.5 * by_tile


@pytest.mark.parametrize("change", [{"means": float("nan")}, {"log_scales": -80.0}, {"log_scales": 9.0}, {"quats": 0.0}], ids=str)
@pytest.mark.parametrize("way", WAYS)
def test_extreme_splats_leave_image_and_gradients_finite(change, way):
    (field, value), (model, order) = next(iter(change.items())), WAYS[way]
    g = random_splats(40, 12)
    tensor = getattr(g, field).clone()
    tensor[7] = value
    g = replace(g, **{field: tensor}).map(lambda t: t.requires_grad_())
    frame = rasterize(Placed(g, translation(0, 0, 5)), CAMERA, model=model, config=RenderConfig(order=order))
    assert frame.rgb.isfinite().all() and frame.alpha.isfinite().all()
    frame.rgb.sum().backward()
    assert all(t.grad.isfinite().all() for t in g.tensors().values())


def test_what_has_no_single_eye_is_refused():
    camera = Camera(Orthographic(10.0, 10.0, 5.0, 5.0), 10, 10, torch.eye(4, dtype=torch.float64))
    with pytest.raises(ValueError, match="one eye"):
        rasterize(random_splats(3, 0), camera, model=RAY)
    moving = replace(CAMERA, shutter="rows", world_from_cam_end=CAMERA.world_from_cam @ pose_from([1.0, 0, 0, 0], [0.1, 0, 0]))
    with pytest.raises(ValueError, match='order "pixel" needs rays'):
        rasterize(random_splats(3, 0), moving, config=RenderConfig(order="pixel"))


def test_an_order_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match='"tile" or "pixel"'):
        RenderConfig(order="ray")
