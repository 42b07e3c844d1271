from dataclasses import replace

import pytest
import torch
from randomized import asset, gaussians

from scenes import Gaussians
from scenes.axes import AXES, axis
from scenes.orbit import AWAY, CAMERA, around


def test_the_middle_is_in_the_middle_from_all_around():
    g = gaussians(2000)
    g.means[:] = g.means * torch.tensor([1.0, 0.3, 0.1]) + torch.tensor([100.0, -50.0, 7.0])
    scene = around(g, "a.ply")
    middle = torch.tensor([100.0, -50.0, 7.0], dtype=torch.float64)
    eyes = []
    for time in scene.frame_times(CAMERA)[::10]:
        camera = scene.camera(CAMERA, int(time))
        eye, turn = camera.world_from_cam[:3, 3], camera.world_from_cam[:3, :3]
        seen = turn.T @ (middle - eye)
        assert seen[2] > 0 and seen[:2].abs().max() < 0.1 * seen[2]
        assert turn[2, 1] < -0.9 and turn[2, 0].abs() < 1e-9  # down is down and the horizon level
        eyes.append(eye)
    assert (torch.stack(eyes).mean(0)[:2] - middle[:2]).abs().max() < 1.5
    radius = (torch.stack(eyes) - middle).norm(dim=1)
    assert radius.std() / radius.mean() < 0.05 and AWAY > 1


def test_a_shift_to_the_left_comes_nearer():
    scene = around(gaussians(200), "a.ply")
    eyes = [scene.camera(CAMERA, 0, ego).world_from_cam[:3, 3] for ego in (scene.ego, scene.ego.shifted(lateral=2.0))]
    assert eyes[1].norm() < eyes[0].norm() - 1


def test_an_asset_keeps_its_model_and_nothing_is_refused():
    assert around(asset(), "a.usdc").model == asset().model
    assert len(around(gaussians(1), "a.ply").background.gaussians) == 1
    with pytest.raises(ValueError, match="a.ply is empty"):
        around(Gaussians.empty(), "a.ply")


@pytest.mark.parametrize("up", AXES)
def test_whichever_axis_points_up_stands_upright_in_the_picture(up):
    head = torch.from_numpy(axis(up, "up")) * 3
    g = gaussians(400)
    g.means[:200] = head.float() + 0.05 * g.means[:200]
    scene = around(g, "a.ply", up)
    above = scene.background.world_from_local[:3, :3] @ head
    assert torch.allclose(above, torch.tensor([0.0, 0.0, 3.0], dtype=torch.float64)) and above @ above == pytest.approx(9)
    assert torch.linalg.det(scene.background.world_from_local[:3, :3]) == pytest.approx(1)
    camera = scene.camera(CAMERA, int(scene.frame_times(CAMERA)[7]))
    local = (camera.world_from_cam.inverse() @ torch.cat([above, torch.ones(1, dtype=torch.float64)]))[:3]
    assert camera.lens.project(local)[1] < camera.height / 2


def test_an_axis_that_is_none_is_refused():
    with pytest.raises(ValueError, match='--up "w" is not an axis'):
        around(gaussians(10), "a.ply", "w")


@pytest.mark.parametrize("sigma", [0.01, 1.0])
def test_one_splat_is_seen_from_outside_it(sigma):
    one = Gaussians(
        torch.tensor([[1.0, 2.0, 3.0]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), sigma).log(), torch.ones(1), torch.ones(1, 1, 3)
    )
    scene = around(one, "a.ply")
    eye = scene.camera(CAMERA, 0).world_from_cam[:3, 3]
    assert 3 * sigma < (eye - one.means[0]).norm() < 20 * sigma
    endless = around(replace(one, log_scales=torch.full((1, 3), 800.0)), "a.ply")
    assert endless.ego.world_from_body.isfinite().all()
