from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.assets.closing import closed, lets_through
from recon.assets.extract import completed
from recon.assets.patching import patched, shown_alone
from recon.commands import _seen_from
from scenes import Asset, Gaussians
from scenes.harmonics import rgb_from_sh, sh_from_rgb

SIZE = torch.tensor([4.4, 1.8, 1.5], dtype=torch.float64)
BACK = {"rear": 30, "left": 10, "right": 10}


def sedan(label="car", sectors=BACK, seed=0) -> Asset:
    """The sides and the back of a car, blue below, dark above, with a bonnet 1.5 m long before a windscreen: what a follower saw."""
    g = torch.Generator().manual_seed(seed)
    x, z = torch.rand(6000, generator=g) * 4.4 - 2.2, 0.2 + torch.rand(6000, generator=g) * 1.3
    keep = (z < 0.9) | (x < 0.7)
    x, z = x[keep], z[keep]
    sides = torch.stack([x, torch.where(torch.rand(len(x), generator=g) < 0.5, -0.9, 0.9), z], 1)
    tail = torch.stack([torch.full((1500,), -2.2), torch.rand(1500, generator=g) * 1.8 - 0.9, 0.2 + torch.rand(1500, generator=g) * 1.3], 1)
    means = torch.cat([sides, tail])
    rgb = torch.where((means[:, 2] < 0.9)[:, None], torch.tensor([0.2, 0.3, 0.8]), torch.tensor([0.1, 0.1, 0.1]))
    n = len(means)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    splats = Gaussians(means, quats, torch.full((n, 3), -3.2), torch.full((n,), 3.0), sh_from_rgb(rgb)[:, None])
    return Asset(splats, SIZE, label, meta={"sectors": dict(sectors)})


def two_tailed() -> Asset:
    """A car with two backs, whole and seen from everywhere."""
    one = sedan(sectors={"front": 9, "rear": 9, "left": 9, "right": 9})
    turned = replace(one.gaussians, means=one.gaussians.means * torch.tensor([-1.0, 1, 1]))
    return replace(one, gaussians=Gaussians.cat([one.gaussians, turned]))


def test_a_front_that_nobody_saw_is_closed_where_the_sides_end():
    hollow = sedan()
    made = closed(hollow)
    n = len(hollow.gaussians)
    assert made.meta["closed"] == ["front"] and hollow.meta.get("closed") is None
    torch.testing.assert_close(made.gaussians.means[:n], hollow.gaussians.means, atol=0, rtol=0)
    added = made.gaussians.select(torch.arange(n, len(made.gaussians)))
    x, y, z = added.means.unbind(1)
    assert x.min() > 0.2 and x.max() < 2.25 and z.max() < 1.5 and y.abs().max() < 0.95
    # a grille at the nose, a bonnet behind it, a windscreen behind that
    for part in ((x > 1.9) & (z < 0.8), (x > 0.9) & (x < 1.8) & (z > 0.75) & (z < 1.0), (x < 0.85) & (z > 1.0)):
        cells = np.unique((y[part] / 0.1).floor().numpy())
        assert len(cells) >= 12, "closed from side to side"
    rgb = rgb_from_sh(added.sh[:, 0])
    assert (rgb[z < 0.75, 2] > 0.7).all() and (rgb[z > 1.05] < 0.2).all(), "in the colours of the sides at its height"
    assert not added.sh[:, 1:].any()


@pytest.mark.parametrize(
    "asset",
    [
        two_tailed(),
        sedan(sectors={}),
        sedan(label="pedestrian"),
        replace(sedan(), gaussians=sedan().gaussians.select(torch.arange(12))),
        replace(sedan(), gaussians=sedan().gaussians.select(torch.arange(0))),
    ],
    ids=["seen from everywhere", "of no known photos", "no vehicle", "of twelve splats", "of none"],
)
def test_others_stay_as_they_are(asset):
    made = closed(asset)
    assert made.meta["closed"] == [] and len(made.gaussians) == len(asset.gaussians)


def test_a_rear_is_closed_as_a_front_is():
    turn = torch.tensor([-1.0, 1, 1])
    back = sedan()
    turned = replace(
        back, gaussians=replace(back.gaussians, means=back.gaussians.means * turn), meta={"sectors": {"front": 30, "left": 10, "right": 10}}
    )
    ours, theirs = closed(turned), closed(back)
    assert ours.meta["closed"] == ["rear"]
    torch.testing.assert_close(ours.gaussians.means * turn, theirs.gaussians.means, atol=1e-5, rtol=0)


def test_what_is_closed_already_stays_as_it_is():
    made = closed(sedan())
    again = closed(replace(made, gaussians=Gaussians.cat([made.gaussians, closed(made).gaussians])))
    assert again.meta["closed"] == [] and len(again.gaussians) == len(made.gaussians) + len(closed(made).gaussians)


def test_a_hole_in_an_end_that_photos_show_is_closed_in_the_colour_around_it():
    whole = sedan()
    x, y, z = whole.gaussians.means.unbind(1)
    hidden = (x < -2.1) & (y.abs() < 0.5) & (z < 0.75)  # behind the bonnet of the next car
    holed = replace(whole, gaussians=whole.gaussians.select(~hidden))
    made = closed(holed)
    added = made.gaussians.select(torch.arange(len(holed.gaussians), len(made.gaussians)))
    patch = added.select(added.means[:, 0] < -1)
    assert made.meta["closed"] == ["front"], "what was seen is no guess as a whole"
    assert patch.means[:, 1].abs().max() < 0.6 and patch.means[:, 2].max() < 0.85
    assert lets_through(made.gaussians, SIZE.numpy(), -1.0, whole.gaussians.means[hidden].double().numpy()).mean() < 0.05
    assert (rgb_from_sh(patch.sh[:, 0])[:, 2] > 0.7).all()


def test_a_front_does_not_get_the_colour_of_tail_lamps():
    car = sedan()
    x, _, z = car.gaussians.means.unbind(1)
    sh = car.gaussians.sh.clone()
    sh[(x < -2.1) & (z > 0.5) & (z < 0.8), 0] = sh_from_rgb(torch.tensor([1.0, 0.0, 0.0]))
    made = closed(replace(car, gaussians=replace(car.gaussians, sh=sh)))
    assert (rgb_from_sh(made.gaussians.sh[len(car.gaussians) :, 0])[:, 0] < 0.5).all()


def test_a_hole_in_a_front_that_photos_show_does_not_get_the_colours_of_the_rear():
    car = two_tailed()
    x, y, z = car.gaussians.means.unbind(1)
    sh = car.gaussians.sh.clone()
    sh[x < -1.9, 0] = sh_from_rgb(torch.tensor([1.0, 0.0, 0.0]))
    seen = replace(car.gaussians, sh=sh).select(~((x > 2.1) & (y.abs() < 0.5) & (z < 0.75)))
    patch, _ = added_to(replace(car, gaussians=seen))
    assert len(patch) > 100 and (patch.means[:, 0] > 2).all() and (rgb_from_sh(patch.sh[:, 0])[:, 0] < 0.5).all()


def saloon(without=None) -> tuple[Asset, Gaussians]:
    """A dense car that was seen from everywhere, and with a hole where `without` of x, y, z says; and what stood in the hole."""
    whole = two_tailed().gaussians
    whole = replace(whole, log_scales=whole.log_scales + 0.3)
    gone = without(*whole.means.unbind(1)) if without else torch.zeros(len(whole), dtype=torch.bool)
    meta = {"sectors": {"front": 9, "rear": 9, "left": 9, "right": 9}}
    return Asset(whole.select(~gone), SIZE, "car", meta=meta), whole.select(gone)


def added_to(asset: Asset) -> tuple[Gaussians, Asset]:
    made = closed(asset)
    return made.gaussians.select(torch.arange(len(asset.gaussians), len(made.gaussians))), made


def test_a_hole_in_a_side_is_closed_behind_its_surface_in_the_colour_around_it():
    holed, gone = saloon(lambda x, y, z: (y > 0) & (x > -0.6) & (x < 0.5) & (z > 0.35) & (z < 0.75))
    patch, made = added_to(holed)
    x, y, z = patch.means.unbind(1)
    assert made.meta["closed"] == [] and 0.15 < made.meta["patched_m2"] < 1.1 * 0.4  # what stands around it reaches in
    assert (x - -0.05).abs().max() < 0.62 and z.min() > 0.28 and z.max() < 0.82
    assert y.min() > 0.83 and y.max() < 0.9, "on its own side, not before what was seen"
    assert (rgb_from_sh(patch.sh[:, 0])[:, 2] > 0.7).all() and not patch.sh[:, 1:].any()
    camera, frame = shown_alone(made.gaussians, SIZE.numpy(), 1, 1.0)
    column, row = camera.lens.project((gone.means.double() - camera.world_from_cam[:3, 3]) @ camera.world_from_cam[:3, :3]).long().unbind(1)
    assert (frame.alpha[row, column] > 0.8).float().mean() > 0.95


@pytest.mark.parametrize("side", [1.0, -1.0])
def test_what_closes_a_side_stands_where_its_hole_was_seen(side):
    """At the middle of pixels, also of a car whose length and height are no whole numbers of them."""
    holed, _ = saloon(lambda x, y, z: (x > -0.6) & (x < 0.5) & (z > 0.35) & (z < 0.75))
    size = SIZE.numpy() + [0.011, 0.0, 0.009]
    patch, _ = patched(holed.gaussians, size)
    camera, _ = shown_alone(holed.gaussians, size, 1, side)
    points = patch.means[patch.means[:, 1] * side > 0].double()
    pixels = camera.lens.project((points - camera.world_from_cam[:3, 3]) @ camera.world_from_cam[:3, :3])
    assert len(points) > 50 and (pixels.frac() - 0.5).abs().max() < 0.01


def test_a_mirrored_side_is_closed_as_the_side_that_was_seen():
    both, _ = saloon(lambda x, y, z: (x > -0.6) & (x < 0.5) & (z > 0.35) & (z < 0.75) & (y.abs() > 0.85))
    half = both.gaussians.select(both.gaussians.means[:, 1] > 0)
    whole, mirrored = completed(half, 9.0, 0.0)
    assert mirrored
    patch, made = added_to(replace(both, gaussians=whole))
    left, right = (patch.means[patch.means[:, 1] * side > 0] * torch.tensor([1.0, side, 1.0]) for side in (1, -1))
    assert len(left) == len(right) > 50
    off = (left[:, None] - right[None]).norm(dim=2).min(1).values
    assert "m2 of its sides" in _seen_from(made)["holes closed"] and "holes closed" not in _seen_from(saloon()[0])
    assert off.max() < 0.05 and 0.3 < made.meta["patched_m2"] < 0.88


def test_a_side_goes_down_to_where_it_begins_and_stays_open_below_an_end_that_rises():
    sill, _ = saloon(lambda x, y, z: (x.abs() < 0.8) & (z < 0.5))
    patch, _ = added_to(sill)
    assert 0.2 < patch.means[:, 2].min() < 0.32 and patch.means[:, 0].abs().max() < 0.9
    rising, _ = saloon(lambda x, y, z: (x > 1.2) & (z < 0.7))
    patch, area = patched(rising.gaussians, SIZE.numpy())
    assert area < 0.3 and not ((patch.means[:, 0] > 1.5) & (patch.means[:, 2] < 0.5)).any()


def test_sides_without_holes_are_left_alone():
    patch, made = added_to(saloon()[0])
    assert len(patch) == 0 and made.meta["patched_m2"] == 0
