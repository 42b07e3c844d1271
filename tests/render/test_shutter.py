"""Shutters that move: camera and actors change their pose while the image is read out, against the float64 oracle."""

import math
from dataclasses import replace

import pytest
import torch

from render import RenderConfig, rasterize, render_frame
from render.projection import poses
from render.rays import world_directions
from scenes import Camera, Equirectangular, Fisheye, OpenCV, Pinhole, Placed, SplatModel, load, save
from scenes.poses import interpolate, inverse, matrix_from_quat, pose_from, translation
from tests import oracle, oracle_lens
from tests.bench.presets import random_splats
from tests.render.test_lenses import EXACT, HEIGHT, LENSES, START, WIDTH, gradients
from tests.render.test_outputs import leaves
from tests.render.test_rasterize import assert_gradient, largest, of_tolerance

PINHOLE = Pinhole(48.0, 50.0, 27.0, 18.0)
FISHEYE = Fisheye(20.0, 20.5, 28.0, 20.0, -0.02, 0.004)
READOUT = 1 / 30


def turned(degrees: float, axis=(0.2, 1.0, 0.3)) -> torch.Tensor:
    half = math.radians(degrees) / 2
    direction = torch.nn.functional.normalize(torch.tensor([float(a) for a in axis]), dim=0) * math.sin(half)
    return pose_from([math.cos(half), *direction.tolist()], [0.0, 0.0, 0.0])


def driven(lens, shutter: str, speed: float = 30.0, rate: float = 100.0) -> Camera:
    """A camera that drives on at `speed` m/s and turns by `rate` degrees a second while its image is read out."""
    end = START @ translation(0.1 * speed * READOUT, 0.0, speed * READOUT) @ turned(rate * READOUT)
    return Camera(lens, WIDTH, HEIGHT, START, end, shutter=shutter)


def traffic(seed: int) -> list[Placed]:
    """A street that stands and a car that comes the other way, turning."""
    pose = pose_from([0.9, -0.1, 0.2, 0.05], [0.5, -0.2, 6.0])
    spread = random_splats(110, seed)
    spread = replace(spread, means=spread.means * torch.tensor([2.0, 1.5, 1.0]))
    car = Placed(random_splats(50, seed + 1, sh_count=4), pose, translation(0.4, 0.1, -0.9) @ pose @ turned(4, (1, 0, 1)), instance=2)
    return [Placed(spread, pose_from([1, 0.1, 0.2, 0.05], [0.1, 0.2, 8.0])), car]


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize(("lens", "shutter"), [(PINHOLE, "rows"), (FISHEYE, "columns")], ids=["pinhole-rows", "fisheye-columns"])
def test_a_moving_shutter_draws_what_the_oracle_draws(lens, shutter, antialias):
    placed, camera, model = traffic(1), driven(lens, shutter), SplatModel(antialias=antialias)
    ends = [p.world_from_local_end for p in placed]
    truth = oracle.as_oracle(placed)
    rgb, alpha, depth, _, unsure = oracle.render(
        truth, camera, model, cutoff=1 / 255, alpha_max=0.999, world_from_cam_end=camera.world_from_cam_end, ends=ends
    )
    frame = rasterize(placed, camera, ("rgb", "alpha", "depth"), model=model, config=RenderConfig(termination=0))
    sure = ~unsure
    assert sure.float().mean() > 0.9 and alpha.mean() > 0.05
    assert largest(frame.rgb, rgb, sure) < 2e-5 * max(1.0, float(rgb.detach().max()))
    assert largest(frame.alpha, alpha, sure) < 2e-5
    still = rasterize([replace(p, world_from_local_end=None) for p in placed], replace(camera, world_from_cam_end=None), model=model)
    assert (still.rgb - frame.rgb).abs().max() > 0.1, "the motion must show"


def crash(seed: int) -> list[Placed]:
    """Traffic of needles and pancakes, some of which reach past the camera."""
    shapes = torch.tensor([[0.4, -3.5, -3.5], [0.0, 0.0, -6.0]])
    return [replace(p, gaussians=replace(p.gaussians, log_scales=shapes[torch.arange(len(p.gaussians)) % 2])) for p in traffic(seed)]


@pytest.mark.parametrize("seed", range(6))
def test_points_that_outrun_the_shutter_are_drawn_as_the_oracle_draws_them(seed):
    """Needles whose ends come by so fast beside the camera that Newton's step leads away from the moment at which they are seen."""
    placed, camera = crash(seed), driven(LENSES["opencv"], "rows")
    with torch.no_grad():
        rgb, *_, unsure = oracle.render(
            oracle.as_oracle(placed), camera, SplatModel(), cutoff=1e-8, alpha_max=0.999,
            world_from_cam_end=camera.world_from_cam_end, ends=[p.world_from_local_end for p in placed],
        )  # fmt: skip
    frame = rasterize(placed, camera, ("rgb",), config=RenderConfig(alpha_cutoff=1e-8, termination=0))
    assert largest(frame.rgb, rgb, ~unsure) < 1e-5


@pytest.mark.parametrize(
    ("lens", "shutter", "make"),
    [
        (PINHOLE, "rows", traffic),
        (PINHOLE, "columns", crash),
        (FISHEYE, "rows", crash),
        (FISHEYE, "columns", traffic),
        (LENSES["opencv"], "rows", traffic),
        (LENSES["ftheta"], "columns", traffic),
        (LENSES["equirectangular"], "rows", traffic),
        (LENSES["orthographic"], "columns", traffic),
    ],
    ids=lambda v: getattr(v, "kind", getattr(v, "__name__", v)),
)
def test_a_moving_shutter_has_the_oracles_gradients(lens, shutter, make):
    """Of every field, the start and end poses of the camera and of the car, and the lens."""
    seen = set()
    for what, mine, reference in gradients(make(2), driven(lens, shutter), SplatModel(antialias=shutter == "rows")):
        assert_gradient(what, mine, reference)
        seen.add(what)
    assert {"camera pose", "camera's end pose", "end pose of 1"} <= seen


def test_what_turns_has_the_oracles_gradients_as_exactly():
    """Camera and car turn by 7 degrees together: were their motion a cubic, this end pose would be 1.7 tolerances off."""
    for what, mine, reference in gradients(traffic(62), driven(LENSES["equirectangular"], "rows"), SplatModel(antialias=True)):
        assert of_tolerance(mine, reference).max() < 1, what


def test_a_motion_is_written_to_a_ten_thousandth_of_a_radian():
    """Where camera and car turn against each other by the most that is drawn, and far more exactly where a car drives."""
    for degrees, off in ((60, 2e-4), (4, 1e-10)):
        camera = Camera(PINHOLE, WIDTH, HEIGHT, START, START @ translation(0.1, 0.2, 1.0) @ turned(degrees), shutter="rows")
        pose = translation(0.5, 0.1, 6)
        car = Placed(random_splats(1, 1), pose, translation(0.3, 0, -0.5) @ pose @ turned(-degrees))
        written = poses(camera, [car])[0]
        for s in torch.linspace(0, 1, 41, dtype=torch.float64):
            seen_from = inverse(interpolate(camera.world_from_cam, camera.world_from_cam_end, s))
            true = seen_from @ interpolate(car.world_from_local, car.world_from_local_end, s)
            found = torch.einsum("k,kij->ij", s ** torch.arange(len(written)), written)
            assert (found - true)[:3, :3].abs().max() < off, degrees


@pytest.mark.parametrize("speed", [60.0, -60.0])
@pytest.mark.parametrize("lens", [PINHOLE, LENSES["opencv"]], ids=lambda lens: lens.kind)
def test_what_the_camera_drives_through_while_it_reads_out_is_not_drawn(lens, speed):
    """Behind it, what a lens says of a splat is no place on the image, by which to find the moment at which it is seen."""
    g, camera = random_splats(80, 1, sh_count=1), driven(lens, "rows", speed, 200)
    placed = [Placed(g, START)]
    poses = torch.stack([inverse(pose) @ START for pose in (camera.world_from_cam, camera.world_from_cam_end)])
    z = g.means.double() @ poses[:, 2, :3].T + poses[:, 2, 3]
    passed = (z.amin(1) < 0.1) & (z.amax(1) > 0.1)
    assert passed.sum() > 10
    drawn = rasterize(placed, camera, config=EXACT).rgb
    assert torch.equal(drawn, rasterize(Placed(g.select(~passed), START), camera, config=EXACT).rgb)
    with torch.no_grad():
        rgb, *_, unsure = oracle.render(
            oracle.as_oracle(placed), camera, SplatModel(), cutoff=1e-8, alpha_max=0.999, world_from_cam_end=camera.world_from_cam_end
        )
    assert largest(drawn, rgb, ~unsure) < 2e-5


def test_a_car_drives_past_a_camera_that_stands():
    """Beside what stands, too, whose moment of readout hangs on nothing."""
    placed, camera = traffic(3), Camera(PINHOLE, WIDTH, HEIGHT, START, shutter="rows")
    for what, mine, reference in gradients(placed, camera, SplatModel()):
        assert_gradient(what, mine, reference)


def test_the_oracles_gradients_through_a_shutter_are_its_finite_differences():
    camera = replace(driven(PINHOLE.scaled(0.25, 0.25), "rows"), width=14, height=10)
    (fields, pose, instance) = oracle.as_oracle([Placed(random_splats(3, 3, sh_count=1), translation(0, 0, 4))])[0]
    still = {name: t.detach() for name, t in fields.items()}

    def moved(by, tilt, shift):
        """A pose that moves along the poses: a matrix that does not rotate is none."""
        top = torch.cat([matrix_from_quat(torch.cat([torch.ones(1, dtype=torch.float64), tilt])), shift[:, None]], 1)
        return by @ torch.cat([top, torch.eye(4, dtype=torch.float64)[3:]])

    def total(tilt, shift, means):
        start, end = moved(camera.world_from_cam, tilt, shift), moved(camera.world_from_cam_end, -tilt, 2 * shift)
        g = {**still, "means": means}
        rgb, *_ = oracle.render([(g, pose.detach(), instance)], camera, SplatModel(), start, world_from_cam_end=end)
        return (rgb.sum(-1) * torch.linspace(-1, 1, 14, dtype=torch.float64)).sum()

    tilt = torch.tensor([0.01, -0.02, 0.005], dtype=torch.float64, requires_grad=True)
    shift = torch.tensor([0.02, 0.01, -0.03], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(total, (tilt, shift, fields["means"]), eps=1e-6, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("lens", [PINHOLE, FISHEYE], ids=lambda lens: lens.kind)
def test_a_shutter_that_does_not_move_is_a_global_one(lens):
    placed = [replace(p, world_from_local_end=p.world_from_local) for p in traffic(4)]
    camera = Camera(lens, WIDTH, HEIGHT, START, START, shutter="rows")
    moving = rasterize(placed, camera, ("rgb", "depth"))
    still = rasterize(traffic_still(placed), replace(camera, world_from_cam_end=None, shutter="global"), ("rgb", "depth"))
    assert (moving.rgb - still.rgb).abs().max() < 1e-5
    near = still.depth < 1e3
    assert (moving.depth / still.depth - 1).abs()[near].max() < 1e-4


def traffic_still(placed: list[Placed]) -> list[Placed]:
    return [replace(p, world_from_local_end=None) for p in placed]


def test_each_row_is_what_a_still_camera_at_its_own_pose_sees():
    """Small splats, which have no extent in time: a row of the moving shutter is that row of a global one at the row's pose."""
    g = random_splats(300, 5)
    placed = [Placed(replace(g, log_scales=torch.full_like(g.log_scales, math.log(0.004))), translation(0, 0, 6))]
    camera = driven(PINHOLE, "rows")
    frame = rasterize(placed, camera, config=RenderConfig(termination=0))
    for row in (3, 20, 36):
        pose = interpolate(camera.world_from_cam, camera.world_from_cam_end, (row + 0.5) / HEIGHT)
        still = rasterize(placed, Camera(PINHOLE, WIDTH, HEIGHT, pose), config=RenderConfig(termination=0))
        # a splat's neighbouring rows are seen a moment later: a 40th of the motion, under a tenth of a pixel
        assert (frame.rgb[row] - still.rgb[row]).abs().mean() < 0.15 * still.rgb[row].abs().mean()


@pytest.mark.parametrize("there", ["rows", "columns", "global"])
@pytest.mark.parametrize("here", ["rows", "columns", "global"])
@pytest.mark.parametrize("lens", [PINHOLE, FISHEYE], ids=lambda lens: lens.kind)
def test_flow_leads_to_where_a_splat_stands_in_the_other_frame(lens, here, there):
    """Small opaque splats, standing and driving; where each lies on either image is the centre of its own feature's weight."""
    side = torch.linspace(-1.2, 1.2, 4)
    means = torch.stack([*torch.meshgrid(side, 0.7 * side, indexing="ij"), torch.zeros(4, 4)], -1).reshape(-1, 3)
    means[:, 2] = torch.linspace(4.0, 6.0, 16)
    dots = random_splats(16, 1, sh_count=1)
    dots = replace(dots, means=means, log_scales=torch.full((16, 3), -3.2), logit_opacities=torch.full((16,), 7.0))
    driving = torch.arange(16) % 3 == 1
    first = START @ translation(0, 0, 0.5)
    pose, step = first, translation(0.25, -0.05, 0.1) @ turned(1.0)

    def frame_at(shutter: str, time: int) -> tuple[list[Placed], Camera]:
        camera = driven(lens, shutter)
        if shutter == "global":
            camera = replace(camera, world_from_cam_end=None)
        begins = torch.linalg.matrix_power(step, time)
        camera = replace(camera, world_from_cam=camera.world_from_cam @ translation(0.05 * time, 0.02, 0.1 * time))
        end = None if shutter == "global" else begins @ step @ pose
        return [Placed(dots.select(~driving), pose), Placed(dots.select(driving), begins @ pose, end, instance=2)], camera

    def centres(placed: list[Placed], camera: Camera) -> torch.Tensor:
        names = torch.eye(16)
        features = [names[~driving], names[driving]]
        weights = rasterize(placed, camera, ("features",), features=features).features.double()
        return (weights[..., None] * camera.pixel_centres()[:, :, None]).sum((0, 1)) / weights.sum((0, 1))[:, None]

    (placed, camera), (later, other) = frame_at(here, 0), frame_at(there, 1)
    before, after = centres(placed, camera), centres(later, other)
    frame = rasterize(placed, camera, ("flow_next", "visible_next", "instance"), flow_to={"next": (later, other)})
    x, y = before.floor().long().unbind(1)
    size = torch.tensor([camera.width, camera.height])
    whole = torch.stack([before, after]).sub(size / 2).abs().lt(size / 2 - 4).all(-1).all(0)  # not cut off by the image's edge
    shown = (frame.instance[y, x] >= 0) & whole
    assert shown.sum() >= 9 and frame.visible_next[y, x][shown].float().mean() > 0.8
    assert (frame.flow_next[y, x] - (after - before))[shown].abs().max() < 0.2  # the pixel's centre is not the splat's
    moved = after - before
    assert (moved[driving].mean(0) - moved[~driving].mean(0)).norm() > 0.5, "the motion must show"


@pytest.mark.parametrize(("lens", "shutter"), [(PINHOLE, "rows"), (FISHEYE, "columns")], ids=["pinhole-rows", "fisheye-columns"])
def test_normals_are_those_of_the_moments_at_which_splats_are_seen(lens, shutter):
    """In the camera as it has turned by then, by up to 20 degrees; with gradients through the moments."""
    placed, camera = traffic(5), driven(lens, shutter, rate=600)
    leaf = lambda t: None if t is None else t.clone().requires_grad_()  # noqa: E731
    truth, ends = oracle.as_oracle(placed), [leaf(p.world_from_local_end) for p in placed]
    start, end = leaf(camera.world_from_cam), leaf(camera.world_from_cam_end)
    painted = []
    for (g, pose, instance), instance_end in zip(truth, ends, strict=True):
        at = oracle_lens.pose_at((start, end), (pose, instance_end))
        then = at(oracle_lens.readout(lens, camera, at, g["means"], torch.zeros_like(g["means"]), True))
        shortest = g["log_scales"].argmin(1)
        axis = matrix_from_quat(g["quats"])[torch.arange(len(shortest)), :, shortest]
        axis = (then[:, :3, :3] @ axis[..., None])[..., 0]
        away = (axis * oracle_lens.transformed(then, g["means"])).sum(-1) > 0
        painted.append(({**g, "features": torch.where(away[:, None], -axis, axis)}, pose, instance))
    *_, sums = oracle.render(
        painted, camera, SplatModel(), start, cutoff=1e-8, alpha_max=0.999, world_from_cam_end=end, ends=ends, features=True
    )
    solid = sums.detach().norm(dim=-1) > 0.2
    weights = torch.randn(*sums.shape, generator=torch.Generator().manual_seed(1)).double() * solid[..., None]
    exact = sums / sums.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    (exact * weights).sum().backward()
    mine = [replace(p, world_from_local_end=leaf(p.world_from_local_end)) for p in leaves(placed)]
    moved = replace(camera, world_from_cam=leaf(camera.world_from_cam), world_from_cam_end=leaf(camera.world_from_cam_end))
    normal = rasterize(mine, moved, ("normal",), config=EXACT).normal
    assert solid.float().mean() > 0.1 and (normal - exact)[solid].abs().max() < 2e-4
    (normal * weights).sum().backward()
    more = [("camera pose", moved.world_from_cam, start), ("end pose", moved.world_from_cam_end, end)]
    of_ends = [(f"end pose of {i}", p.world_from_local_end, e) for i, (p, e) in enumerate(zip(mine, ends, strict=True)) if e is not None]
    for name, a, b in more + of_ends:
        assert_gradient(name, a.grad[:3], b.grad[:3])
    for p, (fields, *_) in zip(mine, truth, strict=True):
        for name in ("means", "quats"):
            assert_gradient(name, getattr(p.gaussians, name).grad, fields[name].grad)


def test_moving_splats_and_camera_by_the_same_motion_shows_nothing_of_it():
    motion = translation(0.3, -0.2, 1.0) @ turned(1)
    start = [Placed(random_splats(120, 6), translation(0, 0, 6))]
    camera = Camera(PINHOLE, WIDTH, HEIGHT, torch.eye(4, dtype=torch.float64), shutter="rows")
    with_it = [replace(p, world_from_local_end=motion @ p.world_from_local) for p in start]
    moving = rasterize(with_it, replace(camera, world_from_cam_end=motion)).rgb
    assert (moving - rasterize(start, camera).rgb).abs().max() < 5e-3  # each is interpolated by itself, about its own origin


def test_extreme_motion_leaves_image_and_gradients_finite():
    g = random_splats(200, 7).map(lambda t: t.requires_grad_())
    for end in (translation(0, 0, 40), translation(30, 0, 0), translation(0, 0, 5) @ turned(55)):
        camera = Camera(PINHOLE, WIDTH, HEIGHT, START, START @ end, shutter="rows")
        frame = rasterize(Placed(g, translation(0, 0, 3)), camera, ("rgb", "alpha"))
        frame.rgb.square().sum().backward()
        assert frame.rgb.isfinite().all() and all(t.grad.isfinite().all() for t in g.tensors().values())


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shutter": "global"}, "the camera has an end pose, which a global shutter never sees"),
        ({"lens": Equirectangular.whole(WIDTH, HEIGHT), "shutter": "columns"}, "no time at its seam"),
        ({"world_from_cam_end": START @ turned(70)}, "the camera turns by 70 degrees"),
        ({"world_from_cam_end": START * torch.nan}, "the end pose of camera is not finite"),
    ],
    ids=["global", "seam", "turn", "nan"],
)
def test_shutters_that_cannot_be_drawn_are_refused_by_name(change, message):
    with pytest.raises(ValueError, match=message):
        rasterize(traffic(8), replace(driven(PINHOLE, "rows"), **change))


def test_ewa_under_a_moving_shutter_is_refused_by_name():
    with pytest.raises(ValueError, match='projection "ut" only'):
        rasterize(traffic(8), driven(PINHOLE, "rows"), model=SplatModel(projection="ewa"))


def test_a_distorting_lens_has_a_shutter_too():
    placed, camera = traffic(9), driven(OpenCV(48.0, 50.0, 27.0, 18.0, -0.2, 0.03), "columns")
    frame = rasterize(placed, camera)
    ends = [p.world_from_local_end for p in placed]
    rgb, *_, unsure = oracle.render(
        oracle.as_oracle(placed),
        camera,
        SplatModel(),
        cutoff=1 / 255,
        alpha_max=0.999,
        world_from_cam_end=camera.world_from_cam_end,
        ends=ends,
    )
    assert largest(frame.rgb, rgb, ~unsure) < 1e-4 * max(1.0, float(rgb.detach().max()))


def test_the_sky_turns_with_the_rows():
    camera = driven(FISHEYE, "rows")
    directions = world_directions(camera)
    for row in (0, 17, HEIGHT - 1):
        pose = interpolate(camera.world_from_cam, camera.world_from_cam_end, (row + 0.5) / HEIGHT)
        still = world_directions(Camera(FISHEYE, WIDTH, HEIGHT, pose))
        assert torch.allclose(directions[row], still[row], atol=1e-6)
    columns = world_directions(replace(camera, shutter="columns"))
    assert torch.allclose(columns[:, 0], world_directions(Camera(FISHEYE, WIDTH, HEIGHT, START))[:, 0], atol=2e-3)


def test_a_recorded_drive_carries_its_shutter(street, tmp_path):
    """Camera and actors end where they are when the readout ends, and a saved scene keeps it."""
    front = replace(street.rig["front_camera"], shutter="rows", readout_us=30_000)
    scene = replace(street, rig={**street.rig, "front_camera": front})
    save(scene, tmp_path / "s")
    scene = load(tmp_path / "s")
    time = int(front.times_us[3])
    camera = scene.camera("front_camera", time)
    assert (camera.shutter, camera.readout_us) == ("rows", 30_000)
    moved = camera.world_from_cam_end[:3, 3] - camera.world_from_cam[:3, 3]
    assert torch.allclose(moved, torch.tensor([0.15, 0.0, 0.0], dtype=torch.float64), atol=1e-9)  # 5 m/s for 30 ms
    background, car = scene.placed(time, camera.readout_us)
    assert background.world_from_local_end is None
    assert float((car.world_from_local_end - car.world_from_local)[0, 3]) == pytest.approx(-0.24)  # 8 m/s the other way
    frame = render_frame(scene, camera)
    assert (frame.rgb - render_frame(street, street.camera("front_camera", time)).rgb).abs().max() > 0.02
    last = scene.camera("front_camera", int(front.times_us[-1]))
    assert last.world_from_cam_end is not None
