"""The rasterizer against the float64 oracle, and its laws."""

import math
from dataclasses import replace

import pytest
import torch

from render import RenderConfig, rasterize
from scenes import Camera, Gaussians, Pinhole, Placed, SplatModel
from scenes.poses import pose_from, translation
from tests import oracle
from tests.bench.presets import random_splats

CAMERA = Camera(Pinhole(60.0, 62.0, 34.0, 22.0), 70, 50, pose_from([1, 0.02, 0.01, -0.03], [0.1, 0.2, -0.3]))
TWICE = torch.diag(torch.tensor([2.0, 2.0, 2.0, 1.0], dtype=torch.float64))
MODELS = [SplatModel(projection=p, antialias=a) for p in ("ewa", "ut") for a in (False, True)]
MODELS += [SplatModel(projection=p).at_scale(0.4) for p in ("ewa", "ut")]
EXACT = RenderConfig(alpha_cutoff=1e-8, termination=0)


def two_instances(seed: int) -> list[Placed]:
    return [
        Placed(random_splats(120, seed), pose_from([1, 0.1, 0.2, 0.05], [0.1, 0.2, 6.0])),
        Placed(random_splats(50, seed + 1, sh_count=4), pose_from([0.9, -0.1, 0.2, 0.05], [0.5, -0.2, 5.0]), instance=3),
    ]


def needles_and_pancakes(seed: int) -> list[Placed]:
    g = random_splats(60, seed)
    shape = torch.tensor([[2.0, -3.5, -3.5], [0.5, 0.5, -9.0]]).repeat(30, 1)
    return [Placed(replace(g, log_scales=shape + 0.2 * g.log_scales), translation(0, 0, 7))]


def off_axis_and_close(seed: int) -> list[Placed]:
    """Splats to either side of the view and up to the camera plane: sigma points behind the camera, EWA's clamp."""
    g = random_splats(80, seed)
    return [Placed(replace(g, means=g.means * torch.tensor([3.0, 2.0, 1.0]), log_scales=g.log_scales + 1), translation(0, 0, 2.5))]


SCENES = [two_instances, needles_and_pancakes, off_axis_and_close]


def largest(a: torch.Tensor, b: torch.Tensor, where: torch.Tensor) -> float:
    return float((a.detach().double() - b.detach()).abs()[where].max())


@pytest.mark.parametrize("model", MODELS, ids=str)
@pytest.mark.parametrize("make", SCENES)
def test_forward_agrees_with_the_oracle(make, model):
    placed = make(1)
    rgb, alpha, depth, instance, near_cutoff = oracle.render(oracle.as_oracle(placed), CAMERA, model, cutoff=1 / 255, alpha_max=0.999)
    frame = rasterize(placed, CAMERA, ("rgb", "alpha", "depth", "instance"), model=model, config=RenderConfig(termination=0))
    sure = ~near_cutoff  # at the cutoff a pixel is in or out by rounding
    assert sure.float().mean() > 0.95
    assert largest(frame.rgb, rgb, sure) < 2e-5 * max(1.0, float(rgb.detach().max()))
    assert largest(frame.alpha, alpha, sure) < 2e-5
    solid = sure & (alpha > 0.01)
    # where little is drawn the weights are tails, which the exp polynomial gives to 1e-4 of themselves
    off = largest(frame.depth / depth, torch.ones_like(depth), solid)
    assert off < 1e-4
    assert (frame.instance != instance)[sure & ((alpha - 0.5).abs() > 1e-4)].float().mean() < 0.002  # ties of two weights
    terminated = rasterize(placed, CAMERA, ("rgb",), model=model)
    assert largest(terminated.rgb, rgb, sure) < 1e-4 * max(1.0, float(rgb.detach().max()))


@pytest.mark.parametrize("width, height", [(3840, 2160), (960, 540)])
def test_a_corner_far_from_the_origin_is_as_exact_as_the_middle(width, height):
    """Splats smaller than a pixel in the corner of a large image, and the oracle's picture of that corner alone: 3,800 pixels from the
    origin a float has 2e-4 pixels, which would show as 1e-4 of a colour."""
    corner = width - 80, height - 60
    dice = torch.Generator().manual_seed(1)
    g = random_splats(200, 1)
    z = 3 + 4 * torch.rand(200, generator=dice)
    pixels = torch.rand(200, 2, generator=dice) * torch.tensor([70.0, 50.0]) + torch.tensor(corner) - torch.tensor([width, height]) / 2
    means = torch.cat([pixels / 2000 * z[:, None], z[:, None]], 1)
    g = replace(g, means=means, log_scales=-6.5 + 0.5 * torch.randn(200, 3, generator=dice))
    still = torch.eye(4, dtype=torch.float64)
    whole = Camera(Pinhole(2000.0, 2000.0, width / 2, height / 2), width, height, still)
    alone = Camera(Pinhole(2000.0, 2000.0, width / 2 - corner[0], height / 2 - corner[1]), 70, 50, still)
    rgb, *_, unsure = oracle.render(oracle.as_oracle([Placed(g, still)]), alone, SplatModel(), cutoff=1 / 255, alpha_max=0.999)
    frame = rasterize(g, whole, ("rgb",), config=RenderConfig(termination=0), crop=(*corner, 70, 50))
    assert largest(frame.rgb, rgb, ~unsure) < 2e-6 * max(1.0, float(rgb.detach().max()))


def of_tolerance(mine: torch.Tensor, reference: torch.Tensor) -> torch.Tensor:
    """How far each entry of a gradient is off, in tolerances: the design page's, 1e-3 of itself and 1e-6 of the largest."""
    allowed = 1e-3 * reference.abs() + 1e-6 * reference.abs().max()
    return (mine.double() - reference).abs() / allowed.clamp_min(1e-300)


def assert_gradient(name: str, mine: torch.Tensor, reference: torch.Tensor) -> None:
    """Within the design page's tolerance; one entry in a hundred may be up to three of them off. Where an entry is what is left of terms a
    thousand times its size, the rounding of floats decides, and processors round differently (with and without AVX-512)."""
    off = of_tolerance(mine, reference)
    beyond = int((off > 1).sum())
    assert off.max() <= 3 and beyond <= 0.01 * off.numel(), f"{name}: {beyond} of {off.numel()} off, worst {float(off.max()):.1f}x"


def gradients_of_both(placed: list[Placed], model: SplatModel):
    """(name, ours, oracle's) for every field, pose and lens parameter of a random linear loss on rgb, alpha and depth."""
    truth = oracle.as_oracle(placed)
    pose, lens = CAMERA.world_from_cam.clone().requires_grad_(), CAMERA.lens.params().requires_grad_()
    rgb, alpha, depth, _, _ = oracle.render(truth, CAMERA, model, pose, lens, cutoff=1e-8, alpha_max=0.999)
    generator = torch.Generator().manual_seed(5)
    weights = [torch.randn(*t.shape, generator=generator).double() for t in (rgb, alpha, depth)]
    seen = alpha > 1e-3

    def loss(rgb, alpha, depth):
        return (rgb * weights[0]).sum() + (alpha * weights[1]).sum() + 0.1 * (depth[seen] * weights[2][seen]).sum()

    loss(rgb, alpha, depth).backward()
    mine = [
        Placed(p.gaussians.map(lambda t: t.clone().requires_grad_()), p.world_from_local.clone().requires_grad_(), instance=p.instance)
        for p in placed
    ]
    my_pose, my_lens = CAMERA.world_from_cam.clone().requires_grad_(), CAMERA.lens.params().requires_grad_()
    camera = replace(CAMERA, lens=Pinhole(*my_lens), world_from_cam=my_pose)
    frame = rasterize(mine, camera, ("rgb", "alpha", "depth"), model=model, config=EXACT)
    loss(frame.rgb, frame.alpha, frame.depth).backward()
    for i, (p, (fields, world_from_local, _)) in enumerate(zip(mine, truth, strict=True)):
        for name, tensor in p.gaussians.tensors().items():
            yield f"{name} of {i}", tensor.grad, fields[name].grad
        yield f"pose of {i}", p.world_from_local.grad[:3], world_from_local.grad[:3]
    yield "camera pose", my_pose.grad[:3], pose.grad[:3]
    yield "lens", my_lens.grad, lens.grad


@pytest.mark.parametrize("model", MODELS, ids=str)
@pytest.mark.parametrize("make", SCENES)
def test_gradients_agree_with_the_oracle(make, model):
    for name, mine, reference in gradients_of_both(make(2), model):
        assert_gradient(name, mine, reference)


@pytest.mark.parametrize("seed", range(100, 114))
def test_gradients_of_needles_agree_with_the_oracle(seed):
    """Their ends move by their length times what their axes are off: with axes in float32 one tensor in a hundred was off."""
    for model in (MODELS[0], MODELS[2]):
        for name, mine, reference in gradients_of_both(needles_and_pancakes(seed), model):
            assert_gradient(name, mine, reference)


def test_gradients_of_nearly_opaque_splats_agree_with_the_oracle():
    """Logits to 30, of which 1 - opacity in floats has lost the digits, and from 17 on all."""
    for logits in ((4.0, 10.0), (12.0, 30.0)):
        placed = [
            replace(p, gaussians=replace(p.gaussians, logit_opacities=torch.linspace(*logits, len(p.gaussians)))) for p in two_instances(4)
        ]
        for name, mine, reference in gradients_of_both(placed, MODELS[2]):
            if name.startswith("logit"):
                assert_gradient(name, mine, reference)


def test_the_oracles_gradients_are_its_finite_differences():
    placed = [Placed(random_splats(6, 3), translation(0, 0, 5))]
    camera = CAMERA.resized(14, 10)
    (fields, pose, instance) = oracle.as_oracle(placed)[0]

    def total(*values):
        g = dict(zip(fields, values[:-1], strict=True))
        rgb, alpha, _, _, _ = oracle.render([(g, values[-1], instance)], camera, SplatModel())
        return (rgb.sum(-1) * torch.linspace(-1, 1, 14, dtype=torch.float64)).sum() + alpha.square().sum()

    assert torch.autograd.gradcheck(total, (*fields.values(), pose), eps=1e-6, atol=1e-5, rtol=1e-4)


def test_the_exact_picture_of_two_crossing_walls_changes_order_where_they_cross():
    """A red wall and a blue one, opaque, each turned by 45 degrees: by their centres one would hide the other everywhere."""
    turn = math.sin(math.pi / 8)
    red, blue = torch.tensor([1.0, -1, -1]), torch.tensor([-1.0, -1, 1])
    walls = Gaussians(
        torch.tensor([[0, 0, 5.0], [0, 0, 5.0001]]),
        torch.tensor([[math.cos(math.pi / 8), 0, turn, 0], [math.cos(math.pi / 8), 0, -turn, 0]]),
        torch.tensor([[1.0, 1.0, -7.0]]).repeat(2, 1),
        torch.full((2,), 20.0),
        torch.stack([red, blue])[:, None],
    )
    camera = replace(CAMERA, lens=Pinhole(60.0, 60.0, 35.0, 25.0), world_from_cam=torch.eye(4, dtype=torch.float64))
    placed = [Placed(walls, torch.eye(4, dtype=torch.float64))]
    rgb, _ = oracle.truth(placed, camera, SplatModel())
    by_centre, _ = oracle.truth(placed, camera, SplatModel(), order="tile")
    left, right = rgb[25, 30] > 0.5, rgb[25, 39] > 0.5
    assert left.tolist() == [False, False, True] and right.tolist() == [True, False, False]
    assert (by_centre[25, [30, 39], 0] > 0.5).all()


def test_zero_splats_renders_background():
    sky = torch.tensor([0.1, 0.5, 0.9])
    frame = rasterize(Gaussians.empty(), CAMERA, ("rgb", "alpha", "depth", "instance"), background=sky)
    assert torch.equal(frame.rgb, sky.expand(50, 70, 3))
    assert (frame.alpha == 0).all() and frame.depth.isinf().all() and (frame.instance == -1).all()


def test_a_background_behind_what_is_nearly_opaque_has_the_oracles_gradient():
    """What passes there, T, has lost its digits in 1 - alpha: by that it would be 5 tolerances off."""
    g = random_splats(3, 3, sh_count=1)
    g = replace(
        g, means=torch.tensor([[0.0, 0, z] for z in range(3)]), log_scales=torch.full((3, 3), 3.0), logit_opacities=torch.full((3,), 5.0)
    )
    placed, background = [Placed(g, translation(0, 0, 5))], torch.zeros(4, 5, 3, requires_grad=True)
    camera = replace(CAMERA.resized(5, 4), world_from_cam=torch.eye(4, dtype=torch.float64))
    rasterize(placed, camera, ("rgb",), background, model=MODELS[2], config=EXACT).rgb.sum().backward()
    _, alpha, *_ = oracle.render(oracle.as_oracle(placed), camera, MODELS[2], alpha_max=0.999)
    assert alpha.min() > 1 - 1e-4
    assert of_tolerance(background.grad[..., 0], 1 - alpha.detach()).max() < 1


def test_hidden_splats_do_not_perturb_render():
    means, quats, log_scales = ([0.0, 0, 3], [1.0, 0, 0, 0], [3.0, 3, -5])
    wall = Gaussians(*(torch.tensor([v] * 3) for v in (means, quats, log_scales)), torch.full((3,), 12.0), torch.ones(3, 1, 3))
    behind = random_splats(50, 4)
    behind = replace(behind, means=behind.means + torch.tensor([0.0, 0, 30]))
    camera = replace(CAMERA, world_from_cam=torch.eye(4, dtype=torch.float64))
    alone = rasterize(wall, camera).rgb
    together = rasterize(Gaussians.cat([wall, behind]), camera).rgb
    assert (alone - together).abs().max() <= 1e-4


def test_rotating_scene_and_camera_together_changes_nothing():
    placed = two_instances(6)
    turn = pose_from([0.7, 0.3, -0.5, 0.4], [3.0, -8.0, 2.0])
    moved = [replace(p, world_from_local=turn @ p.world_from_local) for p in placed]
    here = rasterize(placed, CAMERA).rgb
    there = rasterize(moved, replace(CAMERA, world_from_cam=turn @ CAMERA.world_from_cam)).rgb
    assert (here - there).abs().max() < 1e-5


@pytest.mark.parametrize("metres", [1e4, 1e6, 1e7])
def test_far_from_the_origin_the_picture_is_the_same(metres):
    placed = two_instances(7)
    away = translation(metres, -metres, 0.5 * metres)
    moved = [replace(p, world_from_local=away @ p.world_from_local) for p in placed]
    near = rasterize(placed, CAMERA).rgb
    far = rasterize(moved, replace(CAMERA, world_from_cam=away @ CAMERA.world_from_cam)).rgb
    assert (near - far).abs().max() < 1e-5


def test_splitting_into_instances_changes_nothing():
    g = random_splats(100, 8)
    pose = translation(0, 0, 6)
    whole = rasterize(Placed(g, pose), CAMERA, ("rgb", "alpha", "depth"))
    split = [Placed(g.select(torch.arange(0, 40)), pose), Placed(g.select(torch.arange(40, 100)), pose, instance=1)]
    parts = rasterize(split, CAMERA, ("rgb", "alpha", "depth"))
    for name, picture in whole.outputs().items():
        assert torch.equal(picture, getattr(parts, name)), name


def test_what_was_not_asked_for_is_none_and_does_not_change_the_rest():
    placed = two_instances(9)
    only = rasterize(placed, CAMERA, ("rgb",))
    assert only.alpha is None and only.depth is None and only.instance is None
    both = rasterize(placed, CAMERA, ("rgb", "depth", "instance"))
    assert torch.equal(only.rgb, both.rgb)


def test_the_same_bits_on_any_number_of_threads():
    def run(threads: int):
        torch.set_num_threads(threads)
        g = random_splats(400, 10).map(lambda t: t.requires_grad_())
        pose = translation(0, 0, 5).requires_grad_()
        frame = rasterize(Placed(g, pose), CAMERA)
        frame.rgb.square().sum().backward()
        return [frame.rgb.detach(), pose.grad, *(t.grad for t in g.tensors().values())]

    before = torch.get_num_threads()
    try:
        results = [run(threads) for threads in (1, 2, 3)]
    finally:
        torch.set_num_threads(before)
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0], other, strict=True))


@pytest.mark.parametrize("size", [(1, 1), (17, 3), (1025, 2), (5, 130)])
def test_any_image_size(size):
    width, height = size
    camera = Camera(Pinhole(40.0, 40.0, width / 2, height / 2), width, height, torch.eye(4, dtype=torch.float64))
    placed = [Placed(random_splats(60, 11), translation(0, 0, 4))]
    truth, _, _, _, near_cutoff = oracle.render(oracle.as_oracle(placed), camera, SplatModel(), cutoff=1 / 255, alpha_max=0.999)
    frame = rasterize(placed, camera, ("rgb",), config=RenderConfig(termination=0))
    assert frame.rgb.shape == (height, width, 3)
    assert (frame.rgb.double() - truth.detach()).abs()[~near_cutoff].max() < 2e-5 * float(truth.detach().max().clamp_min(1))


@pytest.mark.parametrize(
    "change",
    [
        {"logit_opacities": -200.0},
        {"logit_opacities": 200.0},
        {"log_scales": math.log(1e-8)},
        {"log_scales": math.log(1e4)},
        {"quats": 0.0},
        {"quats": 1e-42},
        {"means": 1e30},
        {"means": float("nan")},
        {"log_scales": float("inf")},
    ],
    ids=str,
)
@pytest.mark.parametrize("projection", ["ewa", "ut"])
def test_extreme_splats_leave_image_and_gradients_finite(change, projection):
    g = random_splats(60, 12)
    (field, value), (first, *_) = next(iter(change.items())), [7]
    tensor = getattr(g, field).clone()
    tensor[first] = value
    g = replace(g, **{field: tensor}).map(lambda t: t.requires_grad_())
    frame = rasterize(Placed(g, translation(0, 0, 5)), CAMERA, ("rgb", "alpha"), model=SplatModel(projection=projection))
    assert frame.rgb.isfinite().all() and frame.alpha.isfinite().all()
    frame.rgb.sum().backward()
    assert all(t.grad.isfinite().all() for t in g.tensors().values())


def test_flow_follows_camera_and_instance():
    placed = two_instances(13)
    moved = [placed[0], replace(placed[1], world_from_local=translation(0.3, 0, 0) @ placed[1].world_from_local)]
    other = replace(CAMERA, world_from_cam=CAMERA.world_from_cam @ translation(0.05, 0.02, 0.1))
    frame = rasterize(placed, CAMERA, ("depth", "instance", "flow_next"), flow_to={"next": (moved, other)})
    for instance, start, end in [(0, placed[0], moved[0]), (3, placed[1], moved[1])]:
        rows, columns = torch.nonzero(frame.instance == instance, as_tuple=True)
        pixel = torch.stack([columns, rows], -1).double() + 0.5
        ray = CAMERA.lens.unproject(pixel) * frame.depth[rows, columns].double()[:, None]
        world = ray @ CAMERA.world_from_cam[:3, :3].T + CAMERA.world_from_cam[:3, 3]
        motion = end.world_from_local @ start.world_from_local.inverse()
        world = world @ motion[:3, :3].T + motion[:3, 3]
        back = other.world_from_cam.inverse()
        expected = other.lens.project(world @ back[:3, :3].T + back[:3, 3]) - pixel
        assert (frame.flow_next[rows, columns].double() - expected).abs().max() < 1e-3
    sky = frame.instance == -1
    assert sky.any() and frame.flow_next[sky].abs().max() < 1e-4  # the camera only moved


def test_depth_far_behind_faint_splats_is_still_divided_by_its_weight():
    g = random_splats(5, 14)
    g = replace(g, logit_opacities=torch.full((5,), -4.0))
    placed = [Placed(g, translation(0, 0, 5))]
    _, alpha, depth, _, near_cutoff = oracle.render(oracle.as_oracle(placed), CAMERA, SplatModel(), cutoff=1e-8)
    frame = rasterize(placed, CAMERA, ("depth",), config=EXACT)
    seen = (alpha > 1e-6) & ~near_cutoff
    assert (frame.depth[seen] / depth[seen] - 1).abs().max() < 1e-3


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: rasterize(random_splats(3, 0), CAMERA, "rgb"), "outputs must be a tuple"),
        (lambda: rasterize(random_splats(3, 0), CAMERA, ("rbg",)), "rgb"),
        (lambda: rasterize(random_splats(3, 0), CAMERA, ("flow_next",)), "flow_to"),
        (lambda: rasterize(random_splats(3, 0), CAMERA, background=torch.ones(4)), r"background must have shape \(3,\)"),
        (lambda: rasterize(random_splats(3, 0), CAMERA, background=torch.ones(5, 5, 3)), "background must have shape"),
        (lambda: rasterize(random_splats(3, 0), replace(CAMERA, world_from_cam_end=CAMERA.world_from_cam)), "global shutter"),
        (lambda: rasterize(random_splats(3, 0), replace(CAMERA, world_from_cam=CAMERA.world_from_cam * torch.nan)), "not finite"),
        (lambda: rasterize(random_splats(3, 0), replace(CAMERA, world_from_cam=CAMERA.world_from_cam @ TWICE)), "pose of camera scales or"),
        (lambda: rasterize(Placed(random_splats(3, 0), TWICE, instance=7), CAMERA), "pose of instance 7 scales or shears"),
        (lambda: rasterize(random_splats(3, 0), CAMERA, crop=(0, 0, 4)), "crop must be four whole numbers"),
        (lambda: rasterize(random_splats(3, 0), CAMERA, crop=(0, 0, 4.5, 4)), "crop must be four whole numbers"),
    ],
)
def test_what_cannot_be_drawn_is_refused(change, message):
    with pytest.raises(ValueError, match=message):
        change()


def test_two_threads_may_render_at_once():
    from concurrent.futures import ThreadPoolExecutor

    g = random_splats(300, 15)
    alone = rasterize(Placed(g, translation(0, 0, 5)), CAMERA).rgb
    with ThreadPoolExecutor(2) as pool:
        pictures = list(pool.map(lambda _: rasterize(Placed(g, translation(0, 0, 5)), CAMERA).rgb, range(6)))
    assert all(torch.equal(alone, p) for p in pictures)


@pytest.mark.parametrize("seed", range(6))
def test_a_tile_lists_a_splat_exactly_when_one_of_its_pixels_shows_it(seed):
    """Round splats, needles at all angles, giants and dots. A few tiles more are allowed: a needle passes between pixel centres."""
    from render.kernels.types import TILE, Wanted
    from render.settings import Settings
    from tests.render.test_cuda import keep_forward

    generator = torch.Generator().manual_seed(seed)
    g = random_splats(150, seed)
    shape = torch.tensor([0.0, -4.0, -4.0]) + 2.5 * torch.randn(150, 3, generator=generator)
    settings = Settings(150, 100, SplatModel(projection="ewa"), RenderConfig(), Wanted(), (0,))
    kept, _ = keep_forward(settings, replace(g, log_scales=shape), translation(0, 0, 6), Pinhole(120.0, 120.0, 75.0, 50.0))
    x, y, k, m, h, _, s_max = kept.scene.records[:, :7].double().unbind(1)
    rows, columns = torch.meshgrid(torch.arange(settings.tiles_y * TILE) + 0.5, torch.arange(settings.tiles_x * TILE) + 0.5, indexing="ij")
    listed = torch.zeros(len(g), settings.tiles_x * settings.tiles_y, dtype=torch.bool)
    total = int(kept.parts[0].lists.starts[-1])
    tile = torch.repeat_interleave(torch.arange(listed.shape[1]), kept.parts[0].lists.starts.diff().long())
    listed[kept.parts[0].lists.ids[:total].long(), tile] = True
    assert total == int(listed.sum()) == int(kept.scene.counts.sum()), "an entry twice, or a count that lies"
    reached = 0
    for i in torch.nonzero(kept.scene.counts > 0).flatten():
        dx, dy = columns.double() - x[i], rows.double() - y[i]
        s = (k[i] * (dx - m[i] * dy)).square() + h[i] * dy.square()
        by_tile = s.reshape(settings.tiles_y, TILE, settings.tiles_x, TILE).amin((1, 3)).flatten()
        reached += int((by_tile < s_max[i]).sum())
        assert (listed[i] | (by_tile >= s_max[i])).all(), f"splat {int(i)} is missing from a tile that it reaches"
    assert total <= 1.1 * reached + 20, "tiles are listed that the splats do not reach"


@pytest.mark.parametrize("alpha_max", [0.999, 0.9999])
def test_pixels_behind_any_number_of_opaque_splats_keep_their_gradients(alpha_max):
    """Left, eighty opaque walls one behind the other: transmittance goes far below the smallest float. Right, the same rows see far."""
    walls = random_splats(80, 20)
    depth = torch.linspace(-1, 1, 80)[:, None]
    means = torch.cat([torch.tensor([[-1.2, 0.0]]).expand(80, 2) + 0.1 * walls.means[:, :2], depth], 1)
    walls = replace(walls, means=means, log_scales=torch.full((80, 3), -0.4), logit_opacities=torch.linspace(2.5, 9.0, 80))
    far = random_splats(40, 21)
    placed = [Placed(walls, translation(0, 0, 4)), Placed(far, translation(0.8, 0, 8), instance=1)]
    camera = Camera(Pinhole(30.0, 30.0, 16.0, 8.0), 32, 16, torch.eye(4, dtype=torch.float64))
    g = torch.randn(16, 32, 3, generator=torch.Generator().manual_seed(3))
    config = replace(EXACT, alpha_max=alpha_max)

    def leaves(p):
        return replace(p, gaussians=p.gaussians.map(lambda t: t.clone().requires_grad_()))

    ours = [leaves(p) for p in placed]
    frame = rasterize(ours, camera, config=config)
    left, right = (1 - frame.alpha.detach())[8, [2, 30]].tolist()
    assert left < 1e-9 and right > 1e-3
    ((frame.rgb * g).sum() + frame.alpha.square().sum()).backward()
    truth = oracle.as_oracle(placed)
    rgb, alpha, *_ = oracle.render(truth, camera, SplatModel(), alpha_max=alpha_max)
    ((rgb * g).sum() + alpha.square().sum()).backward()
    for p, (fields, _, _) in zip(ours, truth, strict=True):
        for name, tensor in p.gaussians.tensors().items():
            ref = fields[name].grad
            off = (tensor.grad.double() - ref).abs()
            assert (off <= 2e-3 * ref.abs() + 1e-5 * ref.abs().max()).all(), (name, float(off.max()), float(ref.abs().max()))
