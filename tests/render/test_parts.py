"""Crops, masks and many cameras: each the same bits as the whole, at a part of the work; and many cameras as the oracle draws each."""

import random
from dataclasses import replace

import pytest
import torch

from render import RenderConfig, rasterize
from scenes import Camera, Gaussians, Pinhole, Placed, SplatModel
from scenes.poses import pose_from, translation
from tests import oracle
from tests.render.test_lenses import LENSES, around
from tests.render.test_rasterize import EXACT, largest, two_instances
from tests.render.test_shutter import PINHOLE, driven, traffic, turned

CAMERA = Camera(Pinhole(120.0, 122.0, 65.0, 40.0), 139, 75, torch.eye(4, dtype=torch.float64))
NAMES = ("rgb", "alpha", "depth", "median_depth", "normal", "features", "instance", "instance_alpha", "flow_next", "visible_next")
FEATURES = torch.randn(170, 3, generator=torch.Generator().manual_seed(0))
CROPS = [(0, 0, 139, 75), (0, 0, 1, 1), (16, 32, 32, 16), (37, 21, 60, 33), (130, 60, 9, 15)]


def frame_of(placed, **more):
    other = replace(CAMERA, world_from_cam=translation(0.1, 0, 0.2))
    background = torch.linspace(0, 1, 139 * 75 * 3).reshape(75, 139, 3)
    return rasterize(placed, CAMERA, NAMES, background, {"next": (placed, other)}, features=FEATURES, **more)


def same(a: torch.Tensor, b: torch.Tensor) -> bool:
    return torch.equal(a.nan_to_num(nan=-7.0) if a.is_floating_point() else a, b.nan_to_num(nan=-7.0) if b.is_floating_point() else b)


def gradients(placed, loss, **more):
    leaves = [replace(p, gaussians=p.gaussians.map(lambda t: t.clone().requires_grad_())) for p in placed]
    frame = rasterize(leaves, CAMERA, ("rgb", "alpha"), **more)
    loss(frame).backward()
    return [t.grad for p in leaves for t in p.gaussians.tensors().values()]


@pytest.mark.parametrize("most", [1 << 25, 500])
@pytest.mark.parametrize("crop", CROPS, ids=str)
def test_a_crop_is_the_crop_of_the_whole(crop, most):
    placed, (x, y, width, height) = two_instances(2), crop
    whole, part = frame_of(placed), frame_of(placed, crop=crop, config=RenderConfig(most_entries=most))
    for name, picture in part.outputs().items():
        assert picture.shape[:2] == (height, width)
        assert same(picture, getattr(whole, name)[y : y + height, x : x + width]), name


def test_a_crops_gradients_are_those_of_its_pixels_in_the_whole():
    placed, (x, y, width, height) = two_instances(3), (37, 21, 60, 33)
    inside = (slice(y, y + height), slice(x, x + width))
    part = gradients(placed, lambda f: f.rgb.square().sum() + f.alpha.sum(), crop=(x, y, width, height))
    whole = gradients(placed, lambda f: f.rgb[inside].square().sum() + f.alpha[inside].sum())
    for mine, reference in zip(part, whole, strict=True):
        assert (mine - reference).abs().max() <= 1e-5 * reference.abs().max()


@pytest.mark.parametrize("crop", [None, (37, 21, 60, 33)])
@pytest.mark.parametrize("share", [0.0, 0.002, 0.3])
def test_a_mask_shows_the_whole_where_it_is_true_and_nothing_elsewhere(share, crop):
    placed = two_instances(4)
    mask = torch.rand(75, 139, generator=torch.Generator().manual_seed(1)) < share
    x, y, width, height = crop or (0, 0, 139, 75)
    inside = (slice(y, y + height), slice(x, x + width))
    whole, part, here = frame_of(placed), frame_of(placed, mask=mask, crop=crop), mask[inside]
    for name, picture in part.outputs().items():
        assert same(picture[here], getattr(whole, name)[inside][here]), name
    assert (part.alpha[~here] == 0).all() and part.depth[~here].isinf().all() and (part.instance[~here] == -1).all()
    assert (part.features[~here] == 0).all() and part.median_depth[~here].isinf().all()


def test_a_masks_gradients_are_those_of_its_pixels_in_the_whole():
    placed = two_instances(5)
    mask = torch.rand(75, 139, generator=torch.Generator().manual_seed(2)) < 0.01
    part = gradients(placed, lambda f: f.rgb.square().sum() + f.alpha.sum(), mask=mask)
    whole = gradients(placed, lambda f: f.rgb[mask].square().sum() + f.alpha[mask].sum())
    for mine, reference in zip(part, whole, strict=True):
        assert (mine - reference).abs().max() <= 1e-5 * reference.abs().max()


@pytest.mark.parametrize("crop", [(0, 0, 140, 75), (-1, 0, 5, 5), (3, 3, 0, 5), (139, 0, 1, 1)], ids=str)
def test_a_crop_that_leaves_the_image_is_refused(crop):
    with pytest.raises(ValueError, match="139x75"):
        rasterize(two_instances(1), CAMERA, crop=crop)


def test_a_mask_of_another_size_is_refused():
    with pytest.raises(ValueError, match=r"mask must have shape \(75, 139\)"):
        rasterize(two_instances(1), CAMERA, mask=torch.ones(75, 138, dtype=torch.bool))


def test_a_rig_of_ragged_cameras_is_drawn_in_one_call_as_one_by_one():
    placed = two_instances(6)
    lenses = [Pinhole(40.0 + i, 40.0, 20.0 + i, 15.0) for i in range(7)]
    poses = [pose_from([1.0, 0, 0.4 * i, 0], [0.2 * i, 0, 0]) for i in range(7)]
    rig = [Camera(lens, 40 + 3 * i, 30 + i, pose) for i, (lens, pose) in enumerate(zip(lenses, poses, strict=True))]
    together = rasterize(placed, rig)
    assert [tuple(f.rgb.shape) for f in together] == [(30 + i, 40 + 3 * i, 3) for i in range(7)]
    for camera, frame in zip(rig, together, strict=True):
        assert torch.equal(frame.rgb, rasterize(placed, camera).rgb)


@pytest.mark.parametrize("seed", range(3))
def test_a_batch_of_what_was_placed_by_lot_is_drawn_as_the_oracle_draws_each_camera(seed):
    """Among the placed the same splats twice, and none at all; of the cameras one moves."""
    dice = random.Random(seed)
    placed = dice.choice([two_instances, around, traffic])(seed)
    again, end = dice.choice(placed), translation(0.2, 0.0, -0.1)
    way = translation(dice.uniform(-2, 2), dice.uniform(-1, 1), dice.uniform(0, 2)) @ turned(dice.uniform(-90, 90))
    pose = again.world_from_local @ way
    placed += [Placed(again.gaussians, pose, dice.choice([None, end @ pose]), instance=7)]
    placed.insert(dice.randrange(3), Placed(Gaussians.empty(), pose, instance=5))
    features = [torch.eye(4)[i].expand(len(p.gaussians), -1) for i, p in enumerate(placed)]
    rig = [driven(dice.choice([PINHOLE, *LENSES.values()]), "rows", dice.uniform(0, 30), dice.uniform(-60, 60)) for _ in range(2)]
    rig[1] = replace(rig[1], world_from_cam_end=None)
    model = SplatModel(antialias=dice.random() < 0.5)
    names = ("rgb", "alpha", "depth", "instance", "instance_alpha", "features")
    frames = rasterize(placed, rig, names, model=model, features=features, config=EXACT)
    for camera, frame in zip(rig, frames, strict=True):
        truth = oracle.as_oracle(placed)
        for (fields, *_), field in zip(truth, features, strict=True):
            fields["features"] = field.double()
        with torch.no_grad():
            rgb, alpha, depth, _, unsure, sums = oracle.render(
                truth, camera, model, cutoff=1e-8, alpha_max=0.999, features=True,
                world_from_cam_end=camera.world_from_cam_end, ends=[p.world_from_local_end for p in placed],
            )  # fmt: skip
        sure, solid = ~unsure, ~unsure & (alpha > 0.01)
        assert sure.float().mean() > 0.9 and alpha.max() > 0.5
        for name, reference in {"rgb": rgb, "alpha": alpha, "features": sums, "instance_alpha": sums}.items():
            off = largest(getattr(frame, name), reference, sure)
            assert off < 5e-6 * max(1.0, float(reference.max())), f"{name} of {camera.lens.kind} is off by {off:.1e}"
        assert largest(frame.depth / depth, torch.ones_like(depth), solid) < 1e-5
        most, who = sums.max(-1)
        told = sure & (most > 0.5 * alpha + 1e-4) & ((alpha - 0.5).abs() > 1e-4)  # else another may be told
        whose = torch.where(alpha < 0.5, -1, torch.tensor([p.instance for p in placed])[who])
        assert told.float().mean() > 0.1 and torch.equal(frame.instance[told].long(), whose[told])
