import re
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from randomized import START_US, asset, gaussians, scene, trajectory

import scenes
from scenes import Actor, Asset, Camera, Gaussians, Ground, Pinhole, Placed, RigCamera, Sky, SplatModel
from scenes.poses import pose_from, translation
from scenes.sky import linear_from_srgb, srgb_from_linear
from scenes.trajectory import Trajectory, all_at, all_near

EYE = torch.eye(4, dtype=torch.float64)
LENS = Pinhole(500.0, 510.0, 320.5, 200.25)


@pytest.mark.parametrize(
    "change, said",
    [
        ({"means": torch.zeros(5, 4)}, r"means must have shape \(N, 3\), got \(5, 4\)"),
        ({"quats": torch.zeros(4, 4)}, r"quats must have shape \(5, 4\), got \(4, 4\)"),
        ({"log_scales": torch.zeros(5, 3).double()}, "log_scales must be torch.float32, got torch.float64"),
        ({"logit_opacities": torch.zeros(5, 1)}, r"logit_opacities must have shape \(5,\), got \(5, 1\)"),
        ({"sh": torch.zeros(5, 5, 3)}, "sh must have 1, 4, 9 or 16 coefficients, got 5"),
        ({"sh": [1.0]}, "sh must be a torch tensor, got list"),
        ({"sh": torch.zeros(5, 1, 3, device="meta")}, "must be on one device, got cpu, meta"),
    ],
)
def test_gaussians_of_the_wrong_shape_type_or_device_are_refused(change, said):
    with pytest.raises(ValueError, match=said):
        replace(gaussians(5), **change)


@pytest.mark.parametrize(
    "make, said",
    [
        (lambda: SplatModel(projection="magic"), "projection must be one of ut, ewa, got 'magic'"),
        (lambda: SplatModel(response="magic"), "response must be one of conic, ray"),
        (lambda: SplatModel(dilation=float("nan")), "dilation must be at least 0"),
        (lambda: Pinhole(0.0, 1.0, 0.0, 0.0), "fx must be a positive number of pixels, got 0.0"),
        (lambda: Camera(LENS, 0, 5, EYE), "at least 1x1 pixels, got 0x5"),
        (lambda: Camera(LENS, 5, 5, EYE, shutter="rolling"), "shutter must be one of global, rows, columns, got 'rolling'"),
        (lambda: Camera(LENS, 5, 5, torch.eye(3)), "a pose must have shape"),
        (lambda: Camera(LENS, 5, 5, EYE, exposure=torch.eye(3)), r"exposure must have shape \(3, 4\)"),
        (lambda: RigCamera(LENS, 5, 5, EYE, times_us=torch.zeros(2)), "times_us must be torch.int64"),
        (lambda: Placed(gaussians(), EYE[None]), r"world_from_local must have shape \(4, 4\), got \(1, 4, 4\)"),
        (lambda: Asset(gaussians(), [1.0, 0.0, 1.0], "car"), "size must be positive metres"),
        (lambda: Asset(gaussians(), [1.0, 1.0], "car"), r"size must have shape \(3,\)"),
        (lambda: Sky(torch.zeros(2, 2)), r"linear must have shape \(H, W, 3\)"),
        (lambda: Ground(torch.zeros(1, 5), (0, 0), 1.0), "at least 2x2 cells, got"),
        (lambda: Ground(torch.zeros(2, 5), (0, 0), 0.0), "cell must be positive metres"),
        (lambda: replace(scene(), actors=[Actor(asset(), trajectory(), "a")] * 2), "'a' stands twice"),
        (lambda: scene().camera("frnt", 0), 'camera "frnt" is not in s1; it has front camera, left. Did you mean front camera?'),
    ],
)
def test_impossible_values_are_refused_with_what_was_wanted_and_what_came(make, said):
    with pytest.raises(ValueError) as error:
        make()
    assert said in str(error.value) or re.search(said, str(error.value))


@pytest.mark.parametrize("count", [0, 1, 7])
def test_validity_is_told_for_any_number_of_splats(count):
    g = gaussians(count)
    g.validate()
    assert g.checked() is g and g.invalid().tolist() == [False] * count


def test_splats_join_select_and_pad():
    a, b = gaussians(3, 1), gaussians(4, 9)
    both = Gaussians.cat([a, b])
    assert len(both) == 7 and both.sh_degree == 2 and torch.equal(both.sh[:3, 1:], torch.zeros(3, 8, 3))
    assert torch.equal(both.select(torch.arange(7) >= 3).sh, b.sh)
    assert torch.equal(both.with_sh_count(4).sh, both.sh[:, :4])
    assert len(Gaussians.cat([])) == len(Gaussians.empty(4)) == 0


def test_validation_names_the_first_bad_splat_and_counts_them():
    g = gaussians(6)
    g.sh[4, 2, 1] = g.sh[5, 0, 0] = float("nan")
    with pytest.raises(ValueError, match="here: splat 4 has nan in sh, which must be finite; 2 such splats in all"):
        g.validate("here")
    assert g.invalid().tolist() == [False] * 4 + [True] * 2


@given(st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(0.1, 1e4))
def test_projecting_and_unprojecting_return(u, v, z):
    pixel = torch.tensor([u, v], dtype=torch.float64)
    assert torch.allclose(LENS.project(LENS.unproject(pixel) * z), pixel, atol=1e-9)


def test_the_axis_goes_through_the_principal_point():
    assert LENS.project(torch.tensor([0.0, 0.0, 3.0]).double()).tolist() == [320.5, 200.25]
    right_and_down = LENS.project(torch.tensor([1.0, 1.0, 3.0]).double())
    assert right_and_down[0] > 320.5 and right_and_down[1] > 200.25


def test_a_resized_camera_sees_the_same_points_at_scaled_pixels():
    camera = Camera(LENS, 640, 400, EYE)
    point = torch.tensor([0.3, -0.2, 2.0]).double()
    scale = torch.tensor([0.5, 0.25]).double()
    assert torch.allclose(camera.resized(320, 100).lens.project(point), LENS.project(point) * scale)


def test_lens_fields_can_be_learned_without_a_warning(recwarn):
    fx = torch.tensor(500.0, dtype=torch.float64, requires_grad=True)
    Pinhole(fx, 500.0, 0.0, 0.0).params().sum().backward()
    assert fx.grad == 1 and not recwarn.list


def test_pixel_centres_stand_at_one_half():
    centres = Camera(LENS, 3, 2, EYE).pixel_centres()
    assert centres.shape == (2, 3, 2) and centres[0, 0].tolist() == [0.5, 0.5] and centres[1, 2].tolist() == [2.5, 1.5]


def test_the_ground_is_bilinear_inside_and_level_beyond():
    y, x = torch.meshgrid(torch.arange(5.0), torch.arange(6.0), indexing="ij")
    ground = Ground(2 * x - 3 * y, (10.0, -20.0), 0.5)
    dice = torch.Generator().manual_seed(0)
    at = torch.rand(100, 2, generator=dice, dtype=torch.float64) * torch.tensor([2.5, 2.0])
    expected = 2 * at[:, 0] / 0.5 - 3 * at[:, 1] / 0.5  # bilinear is exact on a plane
    assert torch.allclose(ground.height(at + torch.tensor([10.0, -20.0])), expected, atol=1e-9)
    assert float(ground.height(torch.tensor([-1e6, 0.0]))) == float(ground.height(torch.tensor([10.0, 0.0])))
    corners = ground.height(torch.tensor([[10.0, -20.0], [12.5, -18.0]]))
    assert corners.tolist() == [0.0, 2.0 * 5 - 3.0 * 4]


def test_ground_that_is_no_plane_is_bilinear_between_its_points():
    ground = Ground(torch.tensor([[0.0, 1, 0], [0, 0, 4], [8, 0, 0]]), (10.0, 20.0), 2.0)
    at = torch.tensor([[11.2, 20.0], [13.5, 20.0], [13.5, 21.0], [10.0, 22.5], [14.0, 24.0]])
    assert ground.height(at).tolist() == pytest.approx([0.6, 0.25, 1.625, 2.0, 0.0])


def test_the_sky_is_up_above_and_turns_left_from_its_centre():
    linear = torch.zeros(8, 16, 3)
    linear[0], linear[-1] = torch.tensor([0.0, 0, 1]), torch.tensor([0.0, 1, 0])
    linear[2:6, 3:5], linear[2:6, 11:13] = torch.tensor([1.0, 0, 0]), torch.tensor([1.0, 1, 0])  # a quarter from either edge
    linear[2:6, 7:9] = 1
    sky = Sky(linear)
    for direction, colour in (
        ((0, 0, 1), (0, 0, 1)),
        ((0, 0, -1), (0, 1, 0)),
        ((1, 0, 0), (1, 1, 1)),
        ((0, 1, 0), (1, 0, 0)),
        ((0, -1, 0), (1, 1, 0)),
        ((-1, 0, 0), (0, 0, 0)),
    ):
        assert sky.colour(5 * torch.tensor(direction).float()).tolist() == pytest.approx(colour, abs=1e-5)


def test_the_sky_has_no_seam_behind():
    sky = Sky(torch.rand(8, 16, 3, generator=torch.Generator().manual_seed(0)))
    left, right = sky.colour(torch.tensor([[-1.0, 1e-6, 0.2], [-1.0, -1e-6, 0.2]]))
    assert torch.allclose(left, right, atol=1e-4)


@given(st.floats(0, 1e4))
def test_srgb_and_linear_are_inverses(value):
    x = torch.tensor(value, dtype=torch.float64)
    assert float(linear_from_srgb(srgb_from_linear(x))) == pytest.approx(value, rel=1e-4, abs=1e-6)


def test_actors_are_placed_only_while_they_exist_under_their_own_ids():
    made = scene()  # actors of 5, 6, 7 and 8 poses, 100 ms apart
    at = {n: [p.instance for p in made.placed(START_US + n * 100_003)] for n in (0, 5, 7, 11)}
    assert at == {0: [0, 1, 2, 3, 4], 5: [0, 2, 3, 4], 7: [0, 4], 11: [0]}


def test_frames_are_at_the_cameras_own_times_or_the_bodys():
    made = scene()
    assert torch.equal(made.frame_times("front camera"), made.ego.times_us + 7)
    assert torch.equal(made.frame_times("left"), made.ego.times_us)
    shifted = made.camera("left", START_US, made.ego.shifted(lateral=2.0)).world_from_cam
    assert float((shifted - made.camera("left", START_US).world_from_cam).norm()) == pytest.approx(2.0)


def test_importing_scenes_loads_torch_and_numpy_only():
    code = "import sys, scenes; [getattr(scenes, n) for n in ('Scene', 'Databank', 'load', 'validate')]; print(*sys.modules)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name.split(".")[0] for name in run.stdout.split()}
    assert {"torch", "numpy"} <= loaded
    assert not loaded & {"pxr", "warp", "PIL", "av", "pandas", "scipy", "kornia", "trimesh", "open3d"}


def test_every_name_of_the_package_exists_and_others_do_not():
    assert all(getattr(scenes, name) is not None for name in scenes.__all__)
    with pytest.raises(AttributeError, match="no attribute 'Scne'"):
        _ = scenes.Scne


def test_poses_of_many_trajectories_are_those_of_each():
    dice = torch.Generator().manual_seed(4)

    def path(count: int) -> Trajectory:
        poses = pose_from(
            torch.randn(count, 4, dtype=torch.float64, generator=dice), torch.randn(count, 3, dtype=torch.float64, generator=dice)
        )
        return Trajectory(torch.arange(count) * 1000, poses)

    paths = [path(n) for n in (5, 1, 4, 9)]
    for time in (-300, 0, 1000, 2345):
        for mine, alone in zip(all_at(paths, time), [p.at(time) for p in paths], strict=True):
            torch.testing.assert_close(mine, alone, atol=1e-12, rtol=0)
    assert all_at([], 0) == []
    for time in (-(10**9), 2345, 10**9):
        for mine, alone in zip(all_near(paths, time), [p.near(time) for p in paths], strict=True):
            torch.testing.assert_close(mine, alone, atol=1e-9, rtol=1e-9)


def test_a_trajectory_at_many_times_is_the_trajectory_at_each():
    path = Trajectory(torch.tensor([0, 100, 250]), torch.stack([pose_from([1, 0.1 * k, 0, 0.2 * k], [k, 2 * k, 0]) for k in range(3)]))
    times = torch.tensor([-40, 0, 55, 100, 249, 260])
    assert torch.allclose(path.at_each(times), torch.stack([path.at(int(t)) for t in times]), rtol=0, atol=1e-15)
    assert path.at_each(times[:0]).shape == (0, 4, 4)
    beyond = torch.tensor([-10_000, *times.tolist(), 10_000])
    assert path.covers_each(beyond).tolist() == [path.covers(int(t)) for t in beyond]
    assert torch.allclose(path.near_each(beyond), torch.stack([path.near(int(t)) for t in beyond]), rtol=0, atol=1e-15)
    still = Trajectory(torch.tensor([5]), path.world_from_body[:1])
    assert still.covers_each(beyond).all() and torch.equal(still.near_each(beyond)[0], still.near(-10_000))
    with pytest.raises(ValueError, match="time 900 us is outside"):
        path.at_each(torch.tensor([0, 900]))


def test_a_part_of_a_path_is_as_the_whole_within_its_span():
    times = torch.tensor([0, 100, 200, 300, 400])
    poses = translation().repeat(5, 1, 1)
    poses[:, 0, 3] = torch.tensor([0.0, 1, 4, 9, 16], dtype=torch.float64)
    path = Trajectory(times, poses)
    parts = {
        (150, 250): [100, 200, 300], (100, 200): [100, 200], (-50, 20): [0, 100], (350, 900): [300, 400], (900, 950): [400], (-9, -5): [0],
    }  # fmt: skip
    for span, kept in parts.items():
        part = path.within(span)
        assert part.times_us.tolist() == kept, span
        assert all(torch.equal(part.at(t), path.at(t)) for t in kept)
    assert len(Trajectory(times[:1], poses[:1]).within((500, 600))) == 1


@pytest.mark.parametrize("readout_us", [50_000, -50_000])
def test_a_camera_that_reads_upwards_ends_where_its_body_was_before(readout_us):
    ego = Trajectory(torch.tensor([0, 200_000]), torch.stack([translation(0.0, 0.0, 0.0), translation(2.0, 0.0, 0.0)]))
    camera = RigCamera(Pinhole(50.0, 50.0, 32.0, 24.0), 64, 48, translation(0.5, 0.0, 1.0), shutter="rows", readout_us=readout_us)
    seen = camera.along(ego, 100_000)
    assert seen.world_from_cam[:3, 3].tolist() == pytest.approx([1.5, 0, 1])
    assert seen.world_from_cam_end[:3, 3].tolist() == pytest.approx([1.5 + readout_us / 100_000, 0, 1])
