"""Response "ray" and order "pixel": against the float64 oracle, and what each is for."""

import math
from dataclasses import fields, replace

import pytest
import torch

from render import RenderConfig, rasterize
from render.canonical import canonical_frames
from render.kernels.types import Wanted
from render.settings import Settings
from scenes import Camera, Gaussians, OpenCV, Pinhole, Placed, SplatModel
from scenes.lenses import Fisheye
from scenes.poses import pose_from, translation
from tests import oracle
from tests.bench.presets import random_splats
from tests.render.test_cuda import keep_forward
from tests.render.test_lenses import LENSES, around, camera_of
from tests.render.test_outputs import leaves
from tests.render.test_rasterize import CAMERA, EXACT, assert_gradient, largest, off_axis_and_close, two_instances
from tests.render.test_shutter import PINHOLE, driven, traffic

RAY = SplatModel(response="ray")
WAYS = {
    "ray by tile": (RAY, "tile"),
    "ray by pixel": (replace(RAY, projection="ewa", antialias=True), "pixel"),
    "conic by pixel": (SplatModel(), "pixel"),
}
OUTPUTS = ("rgb", "alpha", "depth", "instance")


def tangent(pose: torch.Tensor) -> torch.Tensor:
    """A pose's gradient along what keeps it a pose: `[4, 3]`. Off it a splat's inverse has no one form, and no motion leads there."""
    turn = pose[:3, :3].detach().T @ pose.grad[:3, :3]
    return torch.cat([turn - turn.T, pose.grad[None, :3, 3]])


@pytest.mark.parametrize("way", WAYS)
def test_forward_agrees_with_the_oracle(way):
    model, order = WAYS[way]
    placed = two_instances(1)
    rgb, alpha, depth, instance, unsure = oracle.render(
        oracle.as_oracle(placed), CAMERA, model, cutoff=1 / 255, alpha_max=0.999, order=order
    )
    frame = rasterize(placed, CAMERA, OUTPUTS, model=model, config=RenderConfig(termination=0, order=order))
    sure = ~unsure
    assert sure.float().mean() > 0.9
    assert largest(frame.rgb, rgb, sure) < 2e-5 * max(1.0, float(rgb.detach().max()))
    assert largest(frame.alpha, alpha, sure) < 2e-5
    solid = sure & (alpha > 0.01)
    assert largest(frame.depth / depth, torch.ones_like(depth), solid) < 1e-4
    assert (frame.instance != instance)[sure & ((alpha - 0.5).abs() > 1e-4)].float().mean() < 0.002


def gradients_of_both(placed: list[Placed], camera: Camera, model: SplatModel, order: str):
    """(name, ours, the oracle's) for every field, feature, pose, end pose and lens parameter, of a random loss on rgb, alpha, depth and
    features."""
    dice = torch.Generator().manual_seed(5)
    features = [torch.randn(len(p.gaussians), 2, generator=dice) for p in placed]
    leaf = lambda t: None if t is None else t.clone().requires_grad_()  # noqa: E731
    truth, ends = oracle.as_oracle(placed), [leaf(p.world_from_local_end) for p in placed]
    truth = [(fields | {"features": f.double().requires_grad_()}, *more) for (fields, *more), f in zip(truth, features, strict=True)]
    start, end, lens = leaf(camera.world_from_cam), leaf(camera.world_from_cam_end), leaf(camera.lens.params())
    shown = oracle.render(
        truth, camera, model, start, lens, cutoff=1e-8, alpha_max=0.999, order=order, world_from_cam_end=end, ends=ends, features=True
    )
    rgb, alpha, depth, _, unsure, summed = shown
    weights = [torch.randn(*t.shape, generator=dice).double() for t in (rgb, alpha, depth, summed)]
    seen = (alpha > 1e-3) & ~unsure
    for w in weights:
        w[unsure] = 0

    def loss(rgb, alpha, depth, summed):
        of_depth = 0.1 * (depth[seen] * weights[2][seen]).sum()
        return (rgb * weights[0]).sum() + (alpha * weights[1]).sum() + of_depth + (summed * weights[3]).sum()

    loss(rgb, alpha, depth, summed).backward()
    mine = [replace(p, world_from_local_end=leaf(p.world_from_local_end)) for p in leaves(placed)]
    my_features, my_lens = [leaf(f) for f in features], leaf(camera.lens.params())
    my_camera = replace(
        camera,
        lens=type(camera.lens)(*my_lens),
        world_from_cam=leaf(camera.world_from_cam),
        world_from_cam_end=leaf(camera.world_from_cam_end),
    )
    config = replace(EXACT, order=order)
    frame = rasterize(mine, my_camera, ("rgb", "alpha", "depth", "features"), model=model, config=config, features=my_features)
    loss(frame.rgb, frame.alpha, frame.depth, frame.features).backward()
    poses = {"camera pose": (my_camera.world_from_cam, start), "camera end pose": (my_camera.world_from_cam_end, end)}
    for i, (p, (of, pose, _)) in enumerate(zip(mine, truth, strict=True)):
        for name, tensor in [*p.gaussians.tensors().items(), ("features", my_features[i])]:
            yield f"{name} of {i}", tensor.grad, of[name].grad
        poses |= {f"pose of {i}": (p.world_from_local, pose), f"end pose of {i}": (p.world_from_local_end, ends[i])}
    for name, (ours, theirs) in poses.items():
        if ours is not None:
            yield name, tangent(ours), tangent(theirs)
    for name, a, b in zip([f.name for f in fields(camera.lens)], my_lens.grad, lens.grad, strict=True):
        yield name, a, b


def assert_gradients(placed: list[Placed], camera: Camera, model: SplatModel, order: str) -> set[str]:
    """All of `gradients_of_both` within the tolerance; returns their names."""
    seen = set()
    for name, mine, reference in gradients_of_both(placed, camera, model, order):
        assert_gradient(name, mine, reference)
        seen.add(name)
    return seen


@pytest.mark.parametrize("way", WAYS)
def test_gradients_agree_with_the_oracle(way):
    model, order = WAYS[way]
    for seed in (2, 3):
        assert_gradients(two_instances(seed), CAMERA, model, order)


@pytest.mark.parametrize("seed", [2, 3])
def test_splats_that_reach_far_beside_the_view_are_drawn_within_it(seed):
    """Where distortion sends the outline's points anywhere, no ellipse around them bounds the splat."""
    camera = Camera(OpenCV(16.0, 17.6, 2.0, 19.0, 0.2, -0.046, 0.0, 0.0, 0.005), 34, 38, torch.eye(4, dtype=torch.float64))
    placed = off_axis_and_close(seed)
    with torch.no_grad():
        rgb, *_, unsure = oracle.render(oracle.as_oracle(placed), camera, RAY, cutoff=1 / 255, alpha_max=0.999)
    drawn = rasterize(placed, camera, ("rgb",), model=RAY, config=RenderConfig(termination=0)).rgb
    assert largest(drawn, rgb, ~unsure) < 5e-6 * max(1.0, float(rgb.max()))


def test_pixels_that_no_ray_leads_to_keep_the_centres_order():
    """Past the fold of a lens, where footprints still reach: there no splat has a place along the ray."""
    lens = OpenCV(17.0, 20.0, 3.0, -2.0, -0.31)
    camera = Camera(lens, 33, 33, torch.eye(4, dtype=torch.float64))
    dark = (lens.unproject(camera.pixel_centres()) == 0).all(-1)
    placed = [Placed(random_splats(120, 15), translation(0.8, 0.6, 2.0))]
    with torch.no_grad():
        rgb, alpha, _, _, unsure = oracle.render(
            oracle.as_oracle(placed), camera, SplatModel(), cutoff=1 / 255, alpha_max=0.999, order="pixel"
        )
    by_pixel, by_tile = (rasterize(placed, camera, config=RenderConfig(termination=0, order=o)).rgb for o in ("pixel", "tile"))
    assert (alpha[dark] > 0.1).sum() > 5
    assert largest(by_pixel, rgb, ~unsure) < 5e-6 * max(1.0, float(rgb.max()))
    assert torch.allclose(by_pixel[dark], by_tile[dark], atol=1e-5)


EYES = {
    "orthographic": camera_of(LENSES["orthographic"]),
    "pinhole by rows": driven(PINHOLE, "rows"),
    "fisheye by columns": driven(LENSES["fisheye"], "columns"),
    "equirectangular by rows": driven(LENSES["equirectangular"], "rows"),
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", EYES)
def test_rays_that_begin_in_places_of_their_own_draw_what_the_oracle_draws(name, way):
    """Of an orthographic lens, and where camera and car move while the image is read out: each pixel looks from where it was then."""
    (model, order), camera = WAYS[way], EYES[name]
    placed = traffic(1) if camera.shutter != "global" else around(1)
    model = replace(model, projection="ut") if camera.shutter != "global" else model
    ends = [p.world_from_local_end for p in placed]
    rgb, alpha, _, _, unsure = oracle.render(
        oracle.as_oracle(placed), camera, model, cutoff=1 / 255, alpha_max=0.999, order=order,
        world_from_cam_end=camera.world_from_cam_end, ends=ends,
    )  # fmt: skip
    frame = rasterize(placed, camera, OUTPUTS, model=model, config=RenderConfig(termination=0, order=order))
    sure = ~unsure
    assert sure.float().mean() > 0.9 and alpha.max() > 0.2
    assert largest(frame.rgb, rgb, sure) < 2e-5 * max(1.0, float(rgb.detach().max()))
    assert largest(frame.alpha, alpha, sure) < 2e-5


@pytest.mark.parametrize("name", EYES)
def test_rays_that_begin_in_places_of_their_own_have_the_oracles_gradients(name):
    camera = EYES[name]
    moves = camera.shutter != "global"
    placed = traffic(2) if moves else around(2)
    named = assert_gradients(placed, camera, replace(RAY, antialias=moves), "pixel")
    assert {"camera end pose", "end pose of 1"} <= named or not moves


@pytest.mark.parametrize("way", WAYS)
def test_windows_crops_and_features_are_the_same_bits_as_the_whole(way):
    model, order = WAYS[way]
    placed = two_instances(3)
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
    assert largest(frame.rgb, rgb, ~unsure) < 2e-5 * max(1.0, float(rgb.detach().max()))


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


def test_frames_made_for_an_order_are_those_that_gradients_go_by():
    """By the kernel and by torch, of needles, of quaternions of any length, and of splats so thin that they are nowhere."""
    g, pose = random_splats(60, 6), pose_from([0.9, 0.1, -0.2, 0.3], [0.1, 0.2, 5.0])
    log_scales, quats = g.log_scales.clone(), 3 * g.quats
    log_scales[:20, 1] = -12.0
    log_scales[3, 0], log_scales[4], quats[5] = -250.0, float("-inf"), 0.0
    g = replace(g, log_scales=log_scales, quats=quats)
    settings = Settings(70, 50, SplatModel(), RenderConfig(order="pixel"), Wanted(), (0,), looks=(2,))
    kept, _ = keep_forward(settings, g, pose, Pinhole(60.0, 62.0, 34.0, 22.0), rays=torch.ones(3, 3, 50, 70, dtype=torch.float64))
    drawn = kept.scene.counts > 0
    expected = canonical_frames(g, pose, 2)
    assert drawn[:6].sum() > 3 and drawn.sum() > 40
    off = (kept.scene.frames - expected)[drawn].abs()
    assert (off <= 1e-12 * expected[drawn].abs().amax(1, keepdim=True)).all()


def test_an_order_that_does_not_exist_is_refused():
    with pytest.raises(ValueError, match='"tile" or "pixel"'):
        RenderConfig(order="ray")
