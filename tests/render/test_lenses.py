"""Every lens and moving shutters, drawn and differentiated, against the float64 oracle."""

import math
from dataclasses import replace

import pytest
import torch

from render import RenderConfig, rasterize
from render.compare import psnr
from scenes import Camera, Equirectangular, Fisheye, FTheta, Gaussians, OpenCV, Orthographic, Pinhole, Placed, SplatModel
from scenes.poses import pose_from, translation
from tests import oracle
from tests.bench.presets import random_splats
from tests.render.test_rasterize import assert_gradient, largest

WIDTH, HEIGHT = 56, 40
START = pose_from([1, 0.02, 0.01, -0.03], [0.1, 0.2, -0.3])
LENSES = {
    "opencv": OpenCV(48.0, 50.0, 27.0, 18.0, -0.28, 0.07, 0.002, -0.003, 0.004, 0.02, 0.01, 0.003, 0.002, -0.001, 0.001, 0.002),
    "fisheye": Fisheye(17.0, 17.5, 28.0, 20.0, -0.01, 0.004, -0.0005, 0.0001),
    "ftheta": FTheta(28.0, 20.0, 17.0, 0.2, -0.3, 0.05, 0.01, 1.02, 0.003, -0.002),
    "equirectangular": Equirectangular.whole(WIDTH, HEIGHT),
    "orthographic": Orthographic(9.0, 9.5, 27.0, 19.0),
}
EXACT = RenderConfig(alpha_cutoff=1e-8, termination=0)


def camera_of(lens) -> Camera:
    return Camera(lens, WIDTH, HEIGHT, START)


def around(seed: int, count: int = 130) -> list[Placed]:
    """Two clouds, one ahead and one that surrounds the camera, splats of all shapes."""
    g = random_splats(count, seed)
    wide = random_splats(count // 2, seed + 1, sh_count=4)
    wide = replace(wide, means=wide.means * 2.5 + 0.8 * torch.nn.functional.normalize(wide.means, dim=1))
    return [
        Placed(g, pose_from([1, 0.1, 0.2, 0.05], [0.1, 0.2, 5.0])),
        Placed(wide, pose_from([0.9, -0.1, 0.2, 0.05], [0.2, -0.1, 0.1]), instance=3),
    ]


def stretched(seed: int) -> list[Placed]:
    """Needles and pancakes, some of which reach past the camera and past the lens's edge."""
    g = random_splats(50, seed)
    shape = torch.tensor([[0.7, -3.5, -3.5], [0.3, 0.3, -6.0]]).repeat(25, 1)
    return [Placed(replace(g, means=1.5 * g.means, log_scales=shape + 0.2 * g.log_scales), translation(0, 0, 2.5))]


SCENES = [
    (around, SplatModel()),
    (around, SplatModel(projection="ewa", antialias=True)),
    (stretched, SplatModel(antialias=True)),
]


@pytest.mark.parametrize(("make", "model"), SCENES, ids=["ut", "ewa", "stretched"])
@pytest.mark.parametrize("name", LENSES)
def test_every_lens_draws_what_the_oracle_draws(make, name, model):
    placed, camera = make(1), camera_of(LENSES[name])
    rgb, alpha, depth, instance, unsure = oracle.render(oracle.as_oracle(placed), camera, model, cutoff=1 / 255, alpha_max=0.999)
    frame = rasterize(placed, camera, ("rgb", "alpha", "depth", "instance"), model=model, config=RenderConfig(termination=0))
    sure = ~unsure
    assert sure.float().mean() > 0.9 and alpha.mean() > 0.05
    assert largest(frame.rgb, rgb, sure) < 2e-5 * max(1.0, float(rgb.detach().max()))
    assert largest(frame.alpha, alpha, sure) < 2e-5
    solid = sure & (alpha > 0.01)
    assert largest(frame.depth / depth, torch.ones_like(depth), solid) < 1e-4
    assert (frame.instance != instance)[sure & ((alpha - 0.5).abs() > 1e-4)].float().mean() < 0.002


def test_splats_that_reach_a_pole_of_the_lens_are_drawn_as_the_oracle_draws_them():
    """The radial factor's denominator is 0 at 77 degrees. While the domain went up to there, footprints were endless by rounding."""
    camera = camera_of(OpenCV(17.0, 18.0, 28.0, 20.0, 0.003, -0.001, k4=-0.0022, k5=0.0003, k6=-0.00016))
    g = random_splats(60, 3, sh_count=4)
    angles = torch.linspace(1.1, 1.33, 60)
    placed = [Placed(replace(g, means=torch.stack([2 * angles.sin(), 0.3 * g.means[:, 1], 2 * angles.cos()], 1)), camera.world_from_cam)]
    rgb, alpha, *_, unsure = oracle.render(oracle.as_oracle(placed), camera, SplatModel(), cutoff=1e-8, alpha_max=0.999)
    drawn = rasterize(placed, camera, ("rgb",), config=EXACT).rgb
    assert alpha.max() > 0.3
    assert largest(drawn, rgb, ~unsure) < 2e-5 * max(1.0, float(rgb.detach().max()))


def gradients(placed: list[Placed], camera: Camera, model: SplatModel):
    """(name, ours, the oracle's) for every field, start and end pose, and lens parameter, of a random loss on rgb, alpha, depth."""
    truth = oracle.as_oracle(placed)
    leaf = lambda t: None if t is None else t.clone().requires_grad_()  # noqa: E731
    ends = [leaf(p.world_from_local_end) for p in placed]
    start, end, lens = leaf(camera.world_from_cam), leaf(camera.world_from_cam_end), leaf(camera.lens.params())
    rgb, alpha, depth, _, _ = oracle.render(
        truth, camera, model, start, lens, cutoff=1e-8, alpha_max=0.999, world_from_cam_end=end, ends=ends
    )
    dice = torch.Generator().manual_seed(5)
    weights = [torch.randn(*t.shape, generator=dice).double() for t in (rgb, alpha, depth)]
    seen = alpha > 1e-3

    def loss(rgb, alpha, depth):
        return (rgb * weights[0]).sum() + (alpha * weights[1]).sum() + 0.1 * (depth[seen] * weights[2][seen]).sum()

    loss(rgb, alpha, depth).backward()
    mine = [
        replace(
            p,
            gaussians=p.gaussians.map(lambda t: t.clone().requires_grad_()),
            world_from_local=leaf(p.world_from_local),
            world_from_local_end=leaf(p.world_from_local_end),
        )
        for p in placed
    ]
    my_lens = leaf(camera.lens.params())
    my_camera = replace(
        camera,
        lens=type(camera.lens)(*my_lens),
        world_from_cam=leaf(camera.world_from_cam),
        world_from_cam_end=leaf(camera.world_from_cam_end),
    )
    frame = rasterize(mine, my_camera, ("rgb", "alpha", "depth"), model=model, config=EXACT)
    loss(frame.rgb, frame.alpha, frame.depth).backward()
    for i, (p, (fields, world_from_local, _)) in enumerate(zip(mine, truth, strict=True)):
        for name, tensor in p.gaussians.tensors().items():
            yield f"{name} of {i}", tensor.grad, fields[name].grad
        yield f"pose of {i}", p.world_from_local.grad[:3], world_from_local.grad[:3]
        if p.world_from_local_end is not None:
            yield f"end pose of {i}", p.world_from_local_end.grad[:3], ends[i].grad[:3]
    yield "camera pose", my_camera.world_from_cam.grad[:3], start.grad[:3]
    if end is not None:
        yield "camera's end pose", my_camera.world_from_cam_end.grad[:3], end.grad[:3]
    yield "lens", my_lens.grad, lens.grad


@pytest.mark.parametrize(("make", "model"), SCENES, ids=["ut", "ewa", "stretched"])
@pytest.mark.parametrize("name", LENSES)
def test_every_lens_has_the_oracles_gradients(make, name, model):
    for what, mine, reference in gradients(make(2), camera_of(LENSES[name]), model):
        assert_gradient(what, mine, reference)


def test_parallel_rays_show_a_picture_that_moves_with_the_camera():
    """Whatever the splats' harmonics, and whichever way they are turned: each ray looks the same way."""
    lens, pixels = LENSES["orthographic"], 8
    poses = START, START @ translation(pixels / lens.fx, 0, 0)
    a, b = (rasterize(around(4), replace(camera_of(lens), world_from_cam=pose), ("rgb", "normal"), config=EXACT) for pose in poses)
    assert (a.rgb[:, pixels:] - b.rgb[:, :-pixels]).abs().max() < 1e-4
    assert (a.normal[:, pixels:] - b.normal[:, :-pixels]).abs().max() < 1e-3


def dots(points, scale: float = 0.02) -> Placed:
    """Small opaque white splats at camera points `[n, 3]` of a camera that stands at the origin."""
    points = torch.as_tensor(points, dtype=torch.float32)
    n = len(points)
    quats, sizes = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 3), math.log(scale))
    return Placed(Gaussians(points, quats, sizes, torch.full((n,), 6.0), torch.ones(n, 1, 3)), torch.eye(4, dtype=torch.float64))


def at_origin(lens, width: int = 64, height: int = 48) -> Camera:
    return Camera(lens, width, height, torch.eye(4, dtype=torch.float64))


@pytest.mark.parametrize("projection", ["ut", "ewa"])
@pytest.mark.parametrize(
    "lens",
    [OpenCV(40.0, 40.0, 32.0, 24.0, -0.3), Fisheye(20.0, 20.0, 32.0, 24.0, -0.1), FTheta(32.0, 24.0, 30.0, -7.5)],
    ids=lambda v: v.kind,
)
def test_past_the_fold_over_nothing_is_drawn(lens, projection):
    """Directions past the fold come back into the image; what lies there must not."""
    end, model = lens.limit(), SplatModel(projection=projection)
    beyond = [[math.sin(a) * math.cos(t), math.sin(a) * math.sin(t), math.cos(a)] for a in (end + 0.05, end + 0.3) for t in range(6)]
    beyond = 3 * torch.tensor(beyond)
    inside = lens.project(beyond.double())
    assert ((inside > 0) & (inside < torch.tensor([64, 48]))).all(1).any(), "the formula alone would draw them"
    assert rasterize(dots(beyond), at_origin(lens), ("alpha",), model=model).alpha.max() == 0
    before = [[3 * math.sin(end - 0.2), 0.0, 3 * math.cos(end - 0.2)]]
    assert rasterize(dots(before), at_origin(lens), ("alpha",), model=model).alpha.max() > 0.5


@pytest.mark.parametrize("projection", ["ut", "ewa"])
def test_a_190_degree_fisheye_draws_what_stands_behind_it(projection):
    lens = Fisheye(19.0, 19.0, 32.0, 32.0)
    angle = math.radians(95)
    ring = torch.tensor([[math.sin(angle) * math.cos(t), math.sin(angle) * math.sin(t), math.cos(angle)] for t in (0.3, 2.0, 4.0)]) * 4
    assert (ring[:, 2] < 0).all()
    frame = rasterize(dots(ring, 0.1), at_origin(lens, 64, 64), ("alpha", "depth"), model=SplatModel(projection=projection))
    for u, v in lens.project(ring.double()).tolist():
        assert frame.alpha[int(v), int(u)] > 0.5
        assert float(frame.depth[int(v), int(u)]) == pytest.approx(4.0, rel=1e-4), "the distance, since z is negative there"


@pytest.mark.parametrize("projection", ["ut", "ewa"])
def test_a_splat_at_the_seam_is_drawn_on_both_sides(projection):
    """Turning the camera so that the seam lies elsewhere turns the picture round and changes nothing else."""
    lens, model = Equirectangular.whole(96, 48), SplatModel(projection=projection)
    g = random_splats(150, 4)
    level = torch.tensor([1.0, 0.35, 1.0])  # away from the poles, where a Gaussian on the image is none on the sphere
    away = torch.linspace(3, 6, 150)[:, None]  # apart, so that rounding does not change the order
    g = replace(g, means=away * torch.nn.functional.normalize(g.means * level, dim=1), log_scales=g.log_scales.clamp_max(-1.2))
    camera = at_origin(lens, 96, 48)
    picture = rasterize(g, camera, model=model).rgb
    turned = rasterize(g, replace(camera, world_from_cam=pose_from([0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0])), model=model).rgb
    assert picture[:, [0, -1]].max() > 0.2, "something stands at the seam"
    assert (picture.roll(48, 1) - turned).abs().max() < 2e-4


@pytest.mark.parametrize("response", ["conic", "ray"])
@pytest.mark.parametrize("turns", [0.5, 1.25, -2.25])
def test_a_sphere_whose_middle_lies_far_beside_the_image_is_drawn_as_if_the_camera_was_turned(response, turns):
    """Up to half a turn beside it, where the copies of what stands at the seam were lost, and beyond, where nothing was drawn."""
    lens, model = Equirectangular.whole(96, 48), SplatModel(response=response)
    g = random_splats(150, 4)
    level = torch.tensor([1.0, 0.35, 1.0])
    away = torch.linspace(3, 6, 150)[:, None]
    g = replace(g, means=away * torch.nn.functional.normalize(g.means * level, dim=1), log_scales=g.log_scales.clamp_max(-1.2))
    camera = at_origin(lens, 96, 48)
    half = -math.pi * turns  # of how far the camera turns around y
    turned = replace(camera, world_from_cam=pose_from([math.cos(half), 0.0, math.sin(half), 0.0], [0.0, 0.0, 0.0]))
    aside = replace(camera, lens=replace(lens, cx=48 + 96 * turns))
    expected = rasterize(g, turned, ("rgb", "flow_next"), model=model, flow_to={"next": (g, camera)})
    found = rasterize(g, aside, ("rgb", "flow_next"), model=model, flow_to={"next": (g, camera)})
    assert (found.rgb - expected.rgb).abs().max() < 2e-4
    assert (found.flow_next - expected.flow_next).abs().max() < 1e-2
    back = rasterize(g, camera, ("flow_next",), model=model, flow_to={"next": (g, aside)})
    at = back.flow_next[..., 0] + torch.arange(96) + 0.5
    assert at.min() >= -1e-3 and at.max() <= 96.001, "what flows there falls into the picture"


def test_a_sphere_that_is_shown_more_than_once_is_refused():
    lens = Equirectangular.whole(96, 48)
    with pytest.raises(ValueError, match=r"shows one turn at most, which is 96.0 pixels wide .* got width 120"):
        rasterize(random_splats(5, 0), at_origin(lens, 120, 48))


@pytest.mark.parametrize("projection", ["ut", "ewa"])
def test_an_opencv_lens_without_distortion_is_a_pinhole(projection):
    """Splats beside and behind the camera too: the rules for sigma points that go too near are the same."""
    g = random_splats(200, 5)
    placed = [Placed(replace(g, means=g.means * torch.tensor([3.0, 2.0, 1.0]), log_scales=g.log_scales + 1), translation(0, 0, 2.5))]
    camera, model = at_origin(Pinhole(60.0, 62.0, 30.0, 25.0)), SplatModel(projection=projection)
    pinhole = rasterize(placed, camera, ("rgb", "depth"), model=model)
    opencv = rasterize(placed, replace(camera, lens=OpenCV(60.0, 62.0, 30.0, 25.0)), ("rgb", "depth"), model=model)
    assert (pinhole.rgb - opencv.rgb).abs().max() < 2e-5


@pytest.mark.parametrize("lens", [Pinhole, OpenCV])
def test_the_middle_of_a_wide_view_is_what_a_narrow_camera_shows(street, lens):
    """Coarse ground beside the camera keeps to the picture's border: at 118 degrees it fogged all of it, to 22 dB, while its sigma points
    could stand at half its depth."""
    eye = street.ego.world_from_body[2] @ street.rig["front_camera"].body_from_cam
    focal = 48 / math.tan(math.radians(59))

    def shown(width: int, height: int) -> torch.Tensor:
        return rasterize([street.background], Camera(lens(focal, focal, width / 2, height / 2), width, height, eye), ("rgb",)).rgb

    assert psnr(shown(96, 54)[18:36, 32:64], shown(32, 18)) > 40


@pytest.mark.parametrize(
    "change", [{"means": 1e30}, {"means": math.nan}, {"log_scales": 9.2}, {"log_scales": math.inf}, {"quats": 0.0}], ids=str
)
@pytest.mark.parametrize("name", ["opencv", "fisheye", "equirectangular"])
def test_extreme_splats_leave_image_and_gradients_of_any_lens_finite(name, change):
    ((field, value),) = change.items()
    placed = around(6, 40)
    spoilt = getattr(placed[0].gaussians, field).clone()
    spoilt[7] = value
    g = replace(placed[0].gaussians, **{field: spoilt}).map(lambda t: t.requires_grad_())
    for projection in ("ut", "ewa"):
        frame = rasterize([replace(placed[0], gaussians=g), placed[1]], camera_of(LENSES[name]), model=SplatModel(projection=projection))
        frame.rgb.sum().backward()
        assert frame.rgb.isfinite().all() and all(t.grad.isfinite().all() for t in g.tensors().values())


@pytest.mark.parametrize("name", LENSES)
def test_the_same_bits_on_any_number_of_threads_for_every_lens(name):
    def drawn(threads: int):
        torch.set_num_threads(threads)
        g = random_splats(150, 7).map(lambda t: t.requires_grad_())
        frame = rasterize(Placed(g, translation(0, 0, 3)), camera_of(LENSES[name]))
        frame.rgb.square().sum().backward()
        return [frame.rgb.detach(), *(t.grad for t in g.tensors().values())]

    before = torch.get_num_threads()
    try:
        one, two = drawn(1), drawn(2)
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(a, b) for a, b in zip(one, two, strict=True))
