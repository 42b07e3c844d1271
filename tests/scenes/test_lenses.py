"""Lenses: projection and its inverse, the edge of their domain, and other people's code for the same models."""

import math
from dataclasses import replace

import pytest
import torch

from scenes import Camera, Equirectangular, Fisheye, FTheta, OpenCV, Orthographic, Pinhole, load, save
from scenes.lenses import LENSES
from scenes.lenses.opencv import STEEPEST
from tests import randomized

RATIONAL = (0.2, 0.1, 0.001, -0.002, 0.01, 0.3, 0.05, 0.01)
LENSES_OF_ALL_KINDS = [
    Pinhole(60.0, 62.0, 34.0, 22.0),
    OpenCV(60.0, 62.0, 34.0, 22.0, -0.25, 0.06, 0.001, -0.002),
    OpenCV(60.0, 62.0, 34.0, 22.0, *RATIONAL, 0.001, 0.002, -0.001, 0.0015),
    Fisheye(30.0, 31.0, 34.0, 22.0),
    Fisheye(20.0, 21.0, 34.0, 22.0, -0.01, 0.003, -0.001, 0.0001),
    FTheta(34.0, 22.0, 20.0, 1.0, -0.5, 0.1, 0.01, 1.001, 0.002, -0.003),
    Equirectangular(12.0, 11.0, 34.0, 22.0),
    Orthographic(10.0, 11.0, 34.0, 22.0),
]


def points_of(lens, count=3000, seed=0):
    """Camera points `[n, 3]` that the lens sees, all over its domain."""
    points = 3 * torch.randn(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    if lens.limit() <= math.pi / 2:
        points = torch.cat([points[:, :2], points[:, 2:].abs() + 0.1], 1)
    return points[lens.valid(points)]


@pytest.mark.parametrize("lens", LENSES_OF_ALL_KINDS, ids=lambda lens: lens.kind)
def test_unprojecting_what_was_projected_returns_it(lens):
    points = points_of(lens)
    assert len(points) > 500
    pixels = lens.project(points)
    back = lens.origins(pixels) + lens.depth(points)[:, None] * lens.unproject(pixels)
    assert (back - points).norm(dim=-1).max() < 1e-11


@pytest.mark.parametrize("lens", LENSES_OF_ALL_KINDS, ids=lambda lens: lens.kind)
def test_a_resized_lens_sees_the_same_at_another_scale(lens):
    points = points_of(lens, 100)
    scale = torch.tensor([0.5, 0.7], dtype=torch.float64)
    assert torch.allclose(lens.scaled(0.5, 0.7).project(points), lens.project(points) * scale, atol=1e-12)
    assert lens.scaled(0.5, 0.7).limit() == pytest.approx(lens.limit())


@pytest.mark.parametrize("lens", LENSES_OF_ALL_KINDS, ids=lambda lens: lens.kind)
def test_lenses_are_differentiable_both_ways_in_points_and_parameters(lens):
    points = points_of(lens, 200)
    if lens.limit() <= math.pi / 2:  # not where slopes go to infinity, at 90 degrees
        points = points[points[:, 2] > 0.5 * points.norm(dim=-1)]
    points = points[:6]
    params = lens.params().requires_grad_()
    again = lambda p: type(lens)(*p.unbind())  # noqa: E731
    assert torch.autograd.gradcheck(lambda p, x: again(p).project(x), (params, points.clone().requires_grad_()), atol=1e-6)
    pixels = lens.project(points).detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda p, x: again(p).unproject(x), (params, pixels), atol=1e-6)


def test_a_lens_on_its_axis_is_differentiable():
    for lens in (Fisheye(30.0, 31.0, 34.0, 22.0, 0.1), FTheta(34.0, 22.0, 20.0, 1.0)):
        axis = torch.tensor([[0.0, 0.0, 2.0]], dtype=torch.float64, requires_grad=True)
        lens.project(axis).sum().backward()
        assert torch.allclose(lens.project(axis), torch.tensor([[34.0, 22.0]], dtype=torch.float64))
        assert axis.grad.isfinite().all() and float(axis.grad[0, 0]) == pytest.approx(lens.focal()[0] / 2)
        ray = lens.unproject(torch.tensor([[34.0, 22.0]], dtype=torch.float64))
        assert torch.equal(ray, torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64))


@pytest.mark.parametrize(
    ("lens", "end"),
    [
        (OpenCV(60.0, 60.0, 32.0, 24.0, -0.3), math.atan(1 / math.sqrt(0.9))),  # r - 0.3 r^3 turns where 0.9 r^2 = 1
        (Fisheye(20.0, 20.0, 32.0, 24.0, -0.1), math.sqrt(1 / 0.3)),  # t - 0.1 t^3
        (FTheta(32.0, 24.0, 30.0, -7.5), 2.0),  # 30 t - 7.5 t^2
    ],
    ids=lambda v: getattr(v, "kind", ""),
)
def test_the_domain_ends_where_the_distortion_folds_over(lens, end):
    assert lens.limit() == pytest.approx(end, abs=1e-9)
    ring = torch.tensor([[math.sin(end + d), 0.0, math.cos(end + d)] for d in (-1e-6, 1e-6)], dtype=torch.float64)
    assert lens.valid(ring).tolist() == [True, False]
    edge = lens.project(ring[:1])
    beyond = edge + torch.tensor([[0.5, 0.0]], dtype=torch.float64)
    assert (lens.unproject(beyond) == 0).all(), "no direction leads past the edge"
    assert lens.unproject(edge - 0.5 * (beyond - edge)).norm() > 0.9


def test_the_domain_ends_before_a_pole():
    """r / (1 - r^2 / 4) goes to infinity at r = 2; what a domain up to there showed of splats that reach there was rounding."""
    lens = OpenCV(60.0, 60.0, 32.0, 24.0, k4=-0.25)
    r = torch.tensor(math.tan(lens.limit()), dtype=torch.float64)
    assert 1.8 < r < 2 and float(lens._radial_slope(r)) == pytest.approx(STEEPEST, rel=1e-6)


def test_a_fisheye_sees_behind_itself():
    lens = Fisheye(20.0, 20.0, 48.0, 48.0, -0.01)
    rays = lens.unproject(Camera(lens, 96, 96, torch.eye(4, dtype=torch.float64)).pixel_centres())
    seen = rays.norm(dim=-1) > 0
    assert seen[48].all() and math.degrees(math.acos(float(rays[48, 0, 2]))) > 95
    assert float((rays[seen].norm(dim=-1) - 1).abs().max()) < 1e-12


def test_an_undistorted_lens_is_a_pinhole():
    points = points_of(Pinhole(60.0, 62.0, 34.0, 22.0))
    assert torch.allclose(OpenCV(60.0, 62.0, 34.0, 22.0).project(points), Pinhole(60.0, 62.0, 34.0, 22.0).project(points), atol=1e-12)
    f_theta, fisheye = FTheta(34.0, 22.0, 30.0, 0.0, 0.6, c=1.2), Fisheye(36.0, 30.0, 34.0, 22.0, 0.02)
    assert torch.allclose(f_theta.project(points), fisheye.project(points), atol=1e-11)


def test_kornia_sees_the_same():
    from kornia.geometry.calibration import distort_points
    from kornia.geometry.camera import PinholeCamera
    from kornia.geometry.camera.distortion_kannala_brandt import distort_points_kannala_brandt

    pinhole, opencv = LENSES_OF_ALL_KINDS[0], LENSES_OF_ALL_KINDS[2]
    points = points_of(opencv, 500)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2] = 60.0, 62.0, 34.0, 22.0
    size = torch.tensor([50.0], dtype=torch.float64)
    camera = PinholeCamera(matrix[None], torch.eye(4, dtype=torch.float64)[None], size, size)
    assert torch.allclose(camera.project(points), pinhole.project(points), atol=1e-9)
    straight = pinhole.project(points)
    bent = distort_points(straight[None], matrix[None, :3, :3], opencv.params()[None, 4:])[0]
    assert torch.allclose(bent, opencv.project(points), atol=1e-9)
    fisheye = LENSES_OF_ALL_KINDS[4]
    ahead = points_of(pinhole, 500)
    theirs = distort_points_kannala_brandt(ahead[:, :2] / ahead[:, 2:], fisheye.params())
    assert torch.allclose(theirs, fisheye.project(ahead), atol=1e-9)


@pytest.mark.parametrize(
    ("model", "lens", "extra"),
    [
        ("PINHOLE", LENSES_OF_ALL_KINDS[0], 0),
        ("OPENCV", LENSES_OF_ALL_KINDS[1], 0),
        ("FULL_OPENCV", OpenCV(60.0, 62.0, 34.0, 22.0, *RATIONAL), 0),
        ("OPENCV_FISHEYE", LENSES_OF_ALL_KINDS[4], 0),
        ("THIN_PRISM_FISHEYE", LENSES_OF_ALL_KINDS[4], 4),
    ],
    ids=lambda v: v if isinstance(v, str) else "",
)
def test_colmap_sees_the_same(model, lens, extra):
    import pycolmap

    numbers = lens.params().tolist()
    if model == "THIN_PRISM_FISHEYE":  # fx fy cx cy k1 k2 p1 p2 k3 k4 sx1 sy1
        numbers = [*numbers[:6], 0.0, 0.0, *numbers[6:8], 0.0, 0.0]
    count = len(pycolmap.Camera.create_from_model_name(1, model, 1.0, 68, 44).params)
    camera = pycolmap.Camera(model=model, width=68, height=44, params=numbers[:count])
    points = points_of(lens if lens.limit() < math.pi / 2 else LENSES_OF_ALL_KINDS[0], 500)
    assert torch.allclose(torch.from_numpy(camera.img_from_cam(points.numpy())), lens.project(points), atol=1e-9)


def test_every_lens_is_a_kind_of_its_own():
    assert {type(lens) for lens in LENSES_OF_ALL_KINDS} == set(LENSES.values())
    assert all(type(lens) is LENSES[lens.kind] for lens in LENSES_OF_ALL_KINDS)


def test_the_sphere_is_whole():
    lens = Equirectangular.whole(64, 32)
    directions = torch.tensor([[0.0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]], dtype=torch.float64)
    expected = torch.tensor([[32.0, 16], [48, 16], [16, 16], [32, 32], [32, 0]], dtype=torch.float64)
    assert torch.allclose(lens.project(directions), expected) and float(lens.period()) == pytest.approx(64)


@pytest.mark.parametrize("lens", LENSES_OF_ALL_KINDS, ids=lambda lens: lens.kind)
def test_a_saved_scene_keeps_its_lenses_and_shutters(lens, tmp_path):
    scene = randomized.scene(sky=False, ground=False)
    camera = replace(scene.rig["left"], lens=lens, shutter="columns", readout_us=31_000)
    save(replace(scene, rig={"left": camera}), tmp_path / "s")
    again = load(tmp_path / "s").rig["left"]
    assert again.lens == lens and (again.shutter, again.readout_us) == ("columns", 31_000)


def test_where_a_bent_lens_ends_is_found_as_by_looking_at_every_angle_and_at_once(monkeypatch):
    looked = []
    jacobian = OpenCV._jacobian
    monkeypatch.setattr(OpenCV, "_jacobian", lambda lens, n: looked.append(n.numel()) or jacobian(lens, n))
    generator = torch.Generator().manual_seed(0)
    around = torch.linspace(0, 2 * math.pi, 361, dtype=torch.float64)
    for bent in (0.0, 0.02, 0.2):
        for _ in range(4):
            k = (torch.rand(12, generator=generator, dtype=torch.float64) - 0.5) * 0.4
            k[2:4], k[8:] = k[2:4] * bent, k[8:] * bent
            lens = OpenCV(60.0, 60.0, 32.0, 24.0, *k.tolist())
            looked.clear()
            limit = lens.limit()
            assert sum(looked) < 60_000
            steep = float(lens._radial_slope(torch.tensor(math.tan(limit), dtype=torch.float64))) > 0.99 * STEEPEST
            # inside, every direction sees; just outside, some direction does not, or nothing is left to see, or it ends before a pole
            for angle, sees in ((limit - 1e-3, True), (limit + 1e-3, False)):
                if angle < math.pi / 2 - 2e-3:
                    ring = torch.stack([around.cos(), around.sin()], -1) * math.tan(angle)
                    det = torch.linalg.det(jacobian(lens, ring))
                    assert bool((det > 0).all()) == sees or bent == 0 or steep
