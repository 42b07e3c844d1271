"""Features, normals, instances' alpha, median depth and visibility: against the float64 oracle, and their laws.

The oracle sums colours. A field of any number is a colour to it, three at a time: sh = (field - 1/2) / C0, raised so that none is below 0,
and the raise taken off again with alpha.
"""

from dataclasses import replace

import pytest
import torch

from render import RenderConfig, rasterize
from scenes import Camera, Fisheye, Gaussians, Orthographic, Pinhole, Placed, SplatModel
from scenes.harmonics import sh_from_rgb
from scenes.poses import inverse, matrix_from_quat, pose_from, translation
from tests import oracle
from tests.bench.presets import STILL, random_splats
from tests.render.test_rasterize import CAMERA, EXACT, assert_gradient, two_instances

MODEL = SplatModel()
RAISE = 8.0


def exact_sums(truth, fields, world_from_cam=None, lens=None, cutoff=1e-8):
    """Sums of w f `[H, W, C]` for fields `[n, C]` of each instance, in float64."""
    out = []
    for first in range(0, fields[0].shape[1], 3):
        painted = []
        for (g, pose, instance), field in zip(truth, fields, strict=True):
            three = field[:, first : first + 3]
            three = torch.cat([three, three.new_zeros(len(three), 3 - three.shape[1])], 1)
            painted.append(({**g, "sh": sh_from_rgb(three + RAISE)[:, None]}, pose, instance))
        rgb, alpha, *_ = oracle.render(painted, CAMERA, MODEL, world_from_cam, lens, cutoff=cutoff, alpha_max=0.999)
        out.append(rgb - RAISE * alpha[..., None])
    return torch.cat(out, -1)[..., : fields[0].shape[1]]


def exact_normals(truth, world_from_cam):
    fields = []
    for g, pose, _ in truth:
        cam_from_local = inverse(world_from_cam) @ pose
        shortest = g["log_scales"].argmin(1)
        axis = matrix_from_quat(g["quats"])[torch.arange(len(shortest)), :, shortest] @ cam_from_local[:3, :3].T
        centre = g["means"] @ cam_from_local[:3, :3].T + cam_from_local[:3, 3]
        fields.append(torch.where(((axis * centre).sum(-1) > 0)[:, None], -axis, axis))
    return fields


def leaves(placed):
    return [
        replace(
            p, gaussians=p.gaussians.map(lambda t: t.clone().requires_grad_()), world_from_local=p.world_from_local.clone().requires_grad_()
        )
        for p in placed
    ]


def assert_gradients_agree(mine, truth, more=()):
    for i, (p, (fields, pose, _)) in enumerate(zip(mine, truth, strict=True)):
        for name, tensor in p.gaussians.tensors().items():
            if fields[name].grad is not None:
                assert_gradient(f"{name} of {i}", tensor.grad, fields[name].grad)
        assert_gradient(f"pose of {i}", p.world_from_local.grad[:3], pose.grad[:3])
    for name, tensor, reference in more:
        assert_gradient(name, tensor.grad, reference.grad)


@pytest.mark.parametrize("channels", [1, 7])
def test_features_and_their_gradients_agree_with_the_oracle(channels):
    placed = two_instances(3)
    generator = torch.Generator().manual_seed(channels)
    features = [torch.randn(len(p.gaussians), channels, generator=generator) for p in placed]
    weights = torch.randn(50, 70, channels, generator=generator).double()
    truth, exact = oracle.as_oracle(placed), [f.double().requires_grad_() for f in features]
    pose, lens = CAMERA.world_from_cam.clone().requires_grad_(), CAMERA.lens.params().requires_grad_()
    sums = exact_sums(truth, exact, pose, lens)
    (sums * weights).sum().backward()
    ours, my_features = leaves(placed), [f.clone().requires_grad_() for f in features]
    my_pose, my_lens = CAMERA.world_from_cam.clone().requires_grad_(), CAMERA.lens.params().requires_grad_()
    camera = replace(CAMERA, lens=Pinhole(*my_lens), world_from_cam=my_pose)
    frame = rasterize(ours, camera, ("features",), model=MODEL, config=EXACT, features=my_features)
    assert frame.rgb is None and (frame.features - sums).abs().max() < 5e-5
    (frame.features * weights).sum().backward()
    more = [("camera pose", my_pose, pose), ("lens", my_lens, lens)]
    more += [(f"features of {i}", f, e) for i, (f, e) in enumerate(zip(my_features, exact, strict=True))]
    assert_gradients_agree(ours, truth, more)


def test_normals_and_their_gradients_agree_with_the_oracle():
    placed = two_instances(4)
    truth, pose = oracle.as_oracle(placed), CAMERA.world_from_cam.clone().requires_grad_()
    sums = exact_sums(truth, exact_normals(truth, pose), pose)
    solid = sums.detach().norm(dim=-1) > 0.2
    weights = torch.randn(50, 70, 3, generator=torch.Generator().manual_seed(1)).double() * solid[..., None]
    exact = sums / sums.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    (exact * weights).sum().backward()
    ours, my_pose = leaves(placed), CAMERA.world_from_cam.clone().requires_grad_()
    frame = rasterize(ours, replace(CAMERA, world_from_cam=my_pose), ("normal", "alpha"), model=MODEL, config=EXACT)
    assert (frame.normal - exact)[solid].abs().max() < 2e-4
    length = frame.normal.norm(dim=-1)
    assert ((length - 1).abs() < 1e-5)[frame.alpha > 0.01].all()
    (frame.normal * weights).sum().backward()
    assert_gradients_agree(ours, truth, [("camera pose", my_pose, pose)])


def test_a_wall_shows_its_normal_from_both_sides():
    wall = Gaussians(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.tensor([[1.0, 1.0, -5.0]]), torch.tensor([4.0]), torch.ones(1, 1, 3)
    )
    for side in (-4.0, 4.0):
        turn = [1.0, 0, 0, 0] if side < 0 else [0.0, 0, 1.0, 0]
        camera = Camera(Pinhole(30.0, 30.0, 20.0, 20.0), 40, 40, pose_from(turn, [0, 0, side]))
        frame = rasterize(wall, camera, ("normal",))
        assert torch.allclose(frame.normal[20, 20], torch.tensor([0.0, 0.0, -1.0]), atol=1e-5)


def test_instances_alphas_add_up_to_alpha_and_agree_with_the_oracle():
    placed = two_instances(5)
    frame = rasterize(placed, CAMERA, ("alpha", "instance_alpha"), model=MODEL, config=EXACT)
    assert frame.instance_alpha.shape == (50, 70, 2)
    assert (frame.instance_alpha.sum(-1) - frame.alpha).abs().max() < 1e-5
    masks = [torch.eye(2, dtype=torch.float64)[i].expand(len(p.gaussians), 2) for i, p in enumerate(placed)]
    assert (frame.instance_alpha - exact_sums(oracle.as_oracle(placed), masks)).abs().max() < 2e-5


def floor(step: float, sigma: float) -> Gaussians:
    """Flat splats side by side, 1.5 m below an eye that looks along z."""
    x, z = torch.meshgrid(torch.arange(-7.0, 7.0, step), torch.arange(1.0, 30.0, step), indexing="ij")
    means = torch.stack([x.flatten(), torch.full((x.numel(),), 1.5), z.flatten()], 1)
    quats = torch.tensor([[1.0, 0, 0, 0]]).expand(len(means), 4).contiguous()
    scales = torch.tensor([sigma, 1e-3, sigma]).log().expand(len(means), 3).contiguous()
    return Gaussians(means, quats, scales, torch.full((len(means),), 3.0), torch.zeros(len(means), 1, 3))


@pytest.mark.parametrize("projection", ["ut", "ewa"])
@pytest.mark.parametrize("lens", [Pinhole(300.0, 300.0, 96.0, 64.0), Fisheye(300.0, 300.0, 96.0, 64.0)], ids=["pinhole", "fisheye"])
def test_depth_of_a_floor_is_where_rays_meet_it(lens, projection):
    """By the splats' centres, of which the nearest cover the others, it would be 2 to 3 % too near."""
    camera = Camera(lens, 192, 128, STILL)
    frame = rasterize(floor(0.25, 0.2), camera, ("alpha", "depth", "median_depth"), model=SplatModel(projection=projection))
    rays = lens.unproject(camera.pixel_centres())
    points = rays * (1.5 / rays[..., 1:2])
    seen = (points[..., 2] > 2.5) & (points[..., 2] < 20) & (frame.alpha > 0.9)
    assert seen.float().mean() > 0.3
    for depth in (frame.depth, frame.median_depth):
        off = (depth[seen] / lens.depth(points)[seen] - 1).abs()
        assert off.median() < 0.01 and off.quantile(0.95) < 0.03


def test_a_splat_that_reaches_behind_the_eye_is_nowhere_nearer_than_half_its_depth():
    flat = Gaussians(
        torch.tensor([[0.0, 0.3, 1.0]]),
        torch.tensor([[1.0, 0, 0, 0]]),
        torch.tensor([[1.0, -5.0, 2.0]]),
        torch.tensor([4.0]),
        torch.ones(1, 1, 3),
    )
    camera = Camera(Pinhole(30.0, 30.0, 20.0, 20.0), 40, 40, STILL)
    frame = rasterize(flat, camera, ("alpha", "depth"))
    drawn = frame.alpha > 0
    assert drawn.any() and frame.depth[drawn].min() > 0.49 and frame.depth[drawn].max() < 1.51


def test_median_depth_is_where_less_than_half_the_light_is_left():
    splats = random_splats(40, 6)
    splats = replace(splats, log_scales=splats.log_scales + 0.7, logit_opacities=splats.logit_opacities + 1)
    placed = [Placed(splats, translation(0, 0, 6))]
    camera = CAMERA.resized(35, 25)
    frame = rasterize(placed, camera, ("median_depth", "alpha"), model=MODEL, config=EXACT)
    cam_from_local = inverse(camera.world_from_cam) @ placed[0].world_from_local
    z = (placed[0].gaussians.means.double() @ cam_from_local[:3, :3].T + cam_from_local[:3, 3])[:, 2]
    expected = torch.full((25, 35), torch.inf, dtype=torch.float64)
    unsure = torch.zeros(25, 35, dtype=torch.bool)
    for count in range(1, len(z) + 1):
        nearest, last = (placed[0].gaussians.select(some) for some in (z.argsort()[:count], z.argsort()[count - 1 : count]))
        with torch.no_grad():
            _, alpha, *_ = oracle.render(oracle.as_oracle([replace(placed[0], gaussians=nearest)]), camera, MODEL, alpha_max=0.999)
            _, _, depth, *_ = oracle.render(oracle.as_oracle([replace(placed[0], gaussians=last)]), camera, MODEL)
        expected = torch.where(expected.isinf() & (alpha > 0.5), depth, expected)
        unsure |= (alpha - 0.5).abs() < 1e-4
    assert expected.isfinite().float().mean() > 0.2 and unsure.float().mean() < 0.02
    assert torch.equal(frame.median_depth.isinf()[~unsure], expected.isinf()[~unsure])
    seen = ~unsure & expected.isfinite()
    assert (frame.median_depth[seen] - expected[seen]).abs().max() < 1e-4


def test_what_is_hidden_in_the_other_frame_is_not_visible_there():
    """A board before a wall; the other camera stands 1 m to the right, where the board hides other parts of the wall."""
    flat = torch.tensor([1.0, 0, 0, 0])
    wall = Gaussians(torch.tensor([[0, 0, 10.0]]), flat[None], torch.tensor([[3.0, 3.0, -5.0]]), torch.tensor([9.0]), torch.ones(1, 1, 3))
    board = Gaussians(torch.tensor([[0, 0, 5.0]]), flat[None], torch.tensor([[-0.9, 1.0, -5.0]]), torch.tensor([9.0]), torch.ones(1, 1, 3))
    placed = [Placed(wall, translation(0, 0, 0)), Placed(board, translation(0, 0, 0), instance=1)]
    here = Camera(Pinhole(40.0, 40.0, 40.0, 20.0), 80, 40, torch.eye(4, dtype=torch.float64))
    there = replace(here, world_from_cam=translation(1.0, 0, 0))
    outputs = ("instance", "flow_next", "visible_next")
    frame = rasterize(placed, here, outputs, flow_to={"next": (placed, there)}, config=RenderConfig(alpha_max=1.0))
    assert frame.instance[20, 40] == 1 and bool(frame.visible_next[20, 40])
    # the board stands at x = 40 here and at 32 there; the wall moves by 4 pixels: what is at 36 here is behind the board there
    assert frame.instance[20, 31] == 0 and frame.instance[20, 55] == 0
    assert bool(frame.visible_next[20, 55]) and bool(frame.visible_next[20, 20])
    hidden = (frame.instance[20] == 0) & ~frame.visible_next[20]
    assert hidden[26:36].sum() >= 3 and not hidden[45:].any() and hidden[:4].all()  # the leftmost pixels leave the picture


def test_the_sky_behind_a_map_flows_to_where_its_parallel_rays_lead():
    """All of them to one point of the sky, wherever on the plane they begin."""
    behind = Gaussians(torch.tensor([[0, 0, -9.0]]), torch.eye(4)[:1], torch.zeros(1, 3), torch.zeros(1), torch.ones(1, 1, 3))
    placed = [Placed(behind, translation(0, 0, 0))]
    here = Camera(Orthographic(8.0, 8.0, 20.0, 10.0), 40, 20, translation(1.0, 0, 0))
    there = Camera(Pinhole(40.0, 40.0, 21.0, 11.0), 40, 20, translation(0, 2.0, 0))
    frame = rasterize(placed, here, ("instance", "flow_next"), flow_to={"next": (placed, there)})
    assert (frame.instance == -1).all()
    expected = torch.tensor([21.0, 11.0]) - here.pixel_centres().float()
    assert (frame.flow_next - expected).abs().max() < 1e-4


def test_where_nothing_moves_everything_is_visible_through_thin_splats_too():
    placed = two_instances(7)
    frame = rasterize(placed, CAMERA, ("alpha", "visible_next"), flow_to={"next": (placed, CAMERA)})
    assert ((frame.alpha > 0.01) & (frame.alpha < 0.5)).sum() > 50
    assert frame.visible_next.all()


@pytest.mark.parametrize("order", ["tile", "pixel"])
@pytest.mark.parametrize("response", ["conic", "ray"])
def test_a_pixel_is_of_the_instance_whose_splats_weigh_most_together(response, order):
    """Not of the one that has the heaviest splat: a street is many faint ones on top of each other, a car's door is one."""
    told = []
    for count in (2, 4):
        clouds = [replace(random_splats(60 * n, n), logit_opacities=torch.full((60 * n,), 2.0 - n)) for n in range(1, count + 1)]
        placed = [Placed(g, pose_from([1, 0.1 * n, 0.2, 0.05], [0.1, 0.1 * n, 6.0]), instance=2 * n) for n, g in enumerate(clouds)]
        outputs = ("alpha", "instance", "instance_alpha")
        frame = rasterize(placed, CAMERA, outputs, model=SplatModel(response=response), config=RenderConfig(order=order))
        most, who = frame.instance_alpha.max(-1)
        drawn = frame.alpha > 0.5
        sure = drawn & (2 * most - frame.alpha > 1e-5)  # of two all but ties
        assert sure.float().mean() > 0.2
        assert torch.equal(frame.instance[sure], 2 * who[sure].int())
        assert (frame.instance[~drawn] == -1).all() and (frame.instance[drawn] >= 0).all()
        told.append(frame.instance[sure].unique().numel())
    assert told[0] == 2 and told[1] >= 3


def test_outputs_do_not_change_one_another():
    placed = two_instances(7)
    features = torch.randn(170, 5, generator=torch.Generator().manual_seed(0))
    names = ("rgb", "alpha", "depth", "median_depth", "normal", "features", "instance", "instance_alpha")
    together = rasterize(placed, CAMERA, names, features=features)
    for name in names:
        alone = rasterize(placed, CAMERA, (name,), features=features)
        assert torch.equal(getattr(alone, name), getattr(together, name)), name
        assert list(alone.outputs()) == [name]


@pytest.mark.parametrize(
    ("features", "message"),
    [
        (None, "needs features="),
        (torch.zeros(3, 2), r"features must have shape \(170, C\)"),
        (torch.zeros(170, 129), "1 to 128 channels"),
        ([torch.zeros(120, 2), torch.zeros(50, 3)], "same 1 to 128 channels"),
        ([torch.zeros(120, 2)] * 3, "one for each of the 2 placed"),
    ],
)
def test_features_that_do_not_fit_are_refused(features, message):
    with pytest.raises(ValueError, match=message):
        rasterize(two_instances(1), CAMERA, ("features",), features=features)
