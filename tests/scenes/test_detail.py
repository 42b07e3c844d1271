import math
from dataclasses import replace

import pytest
import torch
from randomized import gaussians
from street import box, car, street

from render import rasterize
from render.compare import psnr
from scenes import Camera, Gaussians, Pinhole, Placed, Trajectory
from scenes.detail import ASIDE, coarser, finest_pixel
from scenes.edit import Edit, coarse, edited
from scenes.insert import insert
from scenes.placement import Placement
from scenes.poses import matrix_from_quat, translation


def fine_car() -> Gaussians:
    return box((4.2, 1.8, 1.5), (0.8, 0.2, 0.1), step=0.05)


def test_from_afar_a_coarser_car_looks_the_same_with_fewer_splats():
    lens = Pinhole(900.0, 900.0, 160.0, 90.0)
    camera = Camera(lens, 320, 180, torch.eye(4, dtype=torch.float64))
    turn = torch.tensor([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 60], [0, 0, 0, 1]], dtype=torch.float64)
    fine, grey = fine_car(), torch.tensor([0.5, 0.5, 0.5])
    coarse = coarser(fine, 60 / 900)
    assert len(coarse) < 0.6 * len(fine)
    pictures = [rasterize(Placed(g, turn), camera, ("rgb",), background=grey).rgb for g in (fine, coarse)]
    assert psnr(*pictures) > 38


def test_merging_keeps_mean_covariance_and_colour():
    g = gaussians(40)
    g = replace(g, means=0.1 * torch.rand(40, 3), logit_opacities=torch.full((40,), 1.0), log_scales=torch.full((40, 3), -3.0))
    one = coarser(g, 1.0)
    assert len(one) == 1
    torch.testing.assert_close(one.means[0], g.means.mean(0), atol=1e-6, rtol=0)
    torch.testing.assert_close(one.sh[0], g.sh.mean(0), atol=1e-6, rtol=0)
    spread = (g.means - g.means.mean(0)).T @ (g.means - g.means.mean(0)) / 40
    wide = one.log_scales.exp().square().sum()
    torch.testing.assert_close(wide, spread.trace() + 3 * torch.tensor(-6.0).exp(), atol=1e-6, rtol=1e-4)


def test_merged_splats_lie_as_their_parts_did():
    g = gaussians(400)
    g = replace(g, means=(torch.arange(400) // 8)[:, None] + 0.4 * torch.rand(400, 3, generator=torch.Generator().manual_seed(1)) + 0.3)
    merged = coarser(replace(g, logit_opacities=torch.zeros(400), log_scales=torch.full((400, 3), -4.0)), 1.0)
    axes = matrix_from_quat(merged.quats.double()) * merged.log_scales.double().exp()[:, None]
    off = (g.means.view(50, 8, 3) - g.means.view(50, 8, 3).mean(1, keepdim=True)).double()
    spread = off.mT @ off / 8 + torch.eye(3) * math.exp(-8)
    torch.testing.assert_close(axes @ axes.mT, spread, atol=1e-6, rtol=1e-3)


def test_detail_is_that_of_where_the_drive_comes_nearest():
    scene = street()
    ego = Trajectory(scene.ego.times_us[:3], torch.stack([translation(x) for x in (0.0, 100.0, 200.0)]))
    stands = Trajectory(torch.tensor([0]), translation(110.0)[None])
    along = Trajectory(ego.times_us[1:], torch.stack([translation(130.0), translation(300.0)]))
    focal = max(max(c.lens.focal()) for c in scene.rig.values())
    pixels = [finest_pixel(replace(scene, ego=ego), path) * focal for path in (stands, along)]
    assert pixels == pytest.approx([10 - ASIDE, 30 - ASIDE])
    front = scene.rig["front_camera"]
    tele = replace(scene, ego=ego, own={"tele": replace(front, lens=front.lens.scaled(2, 2))})
    assert finest_pixel(tele, stands) * focal == pytest.approx((10 - ASIDE) / 2), "a camera of one's own may see more sharply"


def test_of_two_merged_splats_each_counts_as_much_as_it_covers():
    """Of the first the two longest axes span four times as much, and it is half as dense."""
    g = gaussians(2, 1)
    scales, opacities = torch.tensor([[0.2, 0.1, 0.01], [0.05, 0.01, 0.1]]), torch.tensor([0.4, 0.8])
    means = torch.tensor([[0.1, 0.1, 0.1], [0.4, 0.1, 0.1]])
    one = coarser(replace(g, means=means, log_scales=scales.log(), logit_opacities=torch.logit(opacities)), 1.0)
    torch.testing.assert_close(one.means[0], (2 * means[0] + means[1]) / 3, atol=1e-6, rtol=0)
    torch.testing.assert_close(one.sh[0], (2 * g.sh[0] + g.sh[1]) / 3, atol=1e-6, rtol=0)
    wide = one.log_scales[0].exp()
    covered = float(torch.sigmoid(one.logit_opacities[0]) * wide.prod() / wide.min())
    assert covered == pytest.approx(0.4 * 0.02 + 0.8 * 0.005, rel=1e-4), "as much as both do"


def test_splats_alone_in_their_cells_stay_as_they_are():
    g = gaussians(100)
    assert coarser(g, 1e-6) is g
    with pytest.raises(ValueError, match="wider than 0"):
        coarser(g, 0.0)


def test_an_asset_is_put_far_away_with_fewer_splats_than_near():
    asset, scene = replace(car(), gaussians=fine_car()), street()
    near, far = (insert(scene, asset, Placement("car/0001", x, -3.5)).actor.asset.gaussians for x in (8.0, 120.0))
    assert len(far) < 0.5 * len(near) and len(near) > 0.9 * len(asset.gaussians)


def test_an_asset_in_an_actors_place_has_as_many_splats_as_one_put_there():
    asset, scene = replace(car(), gaussians=fine_car()), street()
    put = insert(scene, asset, Placement("car/0001", 120.0, -3.5))
    other = edited(put.scene, Edit(replace={put.actor.track: asset})).actors[-1]
    assert len(other.asset.gaussians) == len(put.actor.asset.gaussians) < 0.5 * len(asset.gaussians)


def far_and_fine():
    """A scene with a car put 120 m ahead, that car's asset, and the same car put 8 m ahead."""
    asset, scene = replace(car(), gaussians=fine_car(), meta={"id": "car/0001"}), street()
    far, near = (insert(scene, asset, Placement("car/0001", x, -3.5)) for x in (120.0, 8.0))
    return far.scene, asset, near.actor


def test_an_inserted_asset_that_is_shifted_nearer_has_the_detail_of_one_put_there():
    scene, asset, near = far_and_fine()
    shift = {scene.actors[-1].track: (-112.0, 0.0)}
    after = edited(scene, Edit(shift=shift, originals={scene.actors[-1].track: asset})).actors[-1]
    assert torch.equal(after.asset.gaussians.means, near.asset.gaussians.means)
    assert after.asset.meta["inserted"] and after.asset.meta["edited"] and not after.recorded
    assert coarse(Edit(shift=shift, originals={scene.actors[-1].track: asset}), scene, "bank") == []


def test_it_is_said_where_the_detail_of_what_comes_nearer_is_not_at_hand():
    scene, _, near = far_and_fine()
    track = scene.actors[-1].track
    (said,) = coarse(Edit(shift={track: (-112.0, 0.0)}), scene, "bank")
    assert said.startswith(f"{track} comes nearer, but bank does not hold the asset car/0001") and said.endswith("--databank")
    assert coarse(Edit(shift={track: (10.0, 0.0)}), scene, "bank") == []
    assert len(edited(scene, Edit(shift={track: (-112.0, 0.0)})).actors[-1].asset.gaussians) < len(near.asset.gaussians)


def test_what_is_shifted_away_loses_the_detail_that_nobody_sees_from_there():
    scene = insert(street(), replace(car(), gaussians=fine_car()), Placement("car/0001", 8.0, -3.5)).scene
    after = edited(scene, Edit(shift={scene.actors[-1].track: (112.0, 0.0)})).actors[-1]
    assert len(after.asset.gaussians) < 0.5 * len(scene.actors[-1].asset.gaussians)
