from dataclasses import replace

import numpy as np
import pytest
import torch

from recon.assets.closing import closed
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


def test_a_front_that_nobody_saw_is_closed_where_the_sides_end():
    hollow = sedan()
    made = closed(hollow)
    n = len(hollow.gaussians)
    assert made.meta["closed"] == ["front"] and hollow.meta.get("closed") is None
    torch.testing.assert_close(made.gaussians.means[:n], hollow.gaussians.means, atol=0, rtol=0)
    added = made.gaussians.select(torch.arange(n, len(made.gaussians)))
    x, y, z = added.means.unbind(1)
    assert x.min() > 0.3 and x.max() < 2.25 and z.max() < 1.5 and y.abs().max() < 0.95
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
        sedan(sectors={"front": 9, "rear": 9, "left": 9, "right": 9}),
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
