"""The grid of a missing shadow."""

import numpy as np
import torch

from enhance.correcting.shade import ACROSS, DOWN, KNOTS, ShadeNet, optical_depth, read_ground, shaded
from enhance.pairs.shards import PairSet, to_bytes, write_shard
from enhance.training.shade_samples import ShadeSampler
from scenes.sky import linear_from_srgb, srgb_from_linear


def test_a_knot_has_its_own_depth_and_beyond_the_grid_is_none():
    depths = torch.rand(2, KNOTS)
    knots = torch.cartesian_prod(torch.tensor(DOWN[1:-1]), torch.tensor(ACROSS[1:-1])).expand(2, -1, -1)
    assert torch.allclose(optical_depth(knots, depths), depths, atol=1e-6)
    beyond = torch.tensor([[DOWN[0], 0.0], [DOWN[-1], 0.0], [1.0, ACROSS[0]], [1.0, ACROSS[-1]], [9.0, 9.0]]).expand(2, -1, -1)
    assert (optical_depth(beyond, depths) == 0).all()


def test_equal_depths_are_equal_between_the_knots():
    places = torch.rand(1, 50, 2) * torch.tensor([1.1, 3.0]) + torch.tensor([0.25, -1.5])
    assert torch.allclose(optical_depth(places, torch.full((1, KNOTS), 0.7)), torch.full((1, 50), 0.7), atol=1e-6)


def test_shade_halves_light_and_not_the_stored_value():
    white = torch.ones(1, 3)
    assert torch.allclose(shaded(white, torch.zeros(1)), white)
    assert abs(float(shaded(white, torch.tensor([0.6931]))[0, 0]) - 0.7354) < 1e-3


def test_black_ground_has_a_gradient():
    depth = torch.zeros(1, requires_grad=True)
    shaded(torch.zeros(1, 3), depth).sum().backward()
    assert torch.isfinite(depth.grad).all()


def ground(dark=1.0, seed=0):
    """Grey ground by an object, `dark` times as bright at its base: sRGB and places."""
    g = torch.Generator().manual_seed(seed)
    places = torch.rand(3000, 2, generator=g) * torch.tensor([2.4, 4.4]) + torch.tensor([-0.4, -2.2])
    at_base = (places[:, :1] - 1).abs().lt(0.3) & places[:, 1:].abs().lt(1)
    return torch.where(at_base, dark, 1.0) * torch.rand(3000, 1, generator=g).mul(0.1).add(0.4).expand(-1, 3), places


def read(rgb, places):
    return read_ground(rgb[None], places[None], torch.ones(1, len(places), dtype=torch.bool))[0]


def test_a_new_network_shades_nothing_and_reads_darkness_where_it_is():
    bright, dark = read(*ground()), read(*ground(0.3))
    assert (ShadeNet()(bright[None]) == 0).all()
    fell = (bright - dark)[:KNOTS].reshape(len(DOWN) - 2, len(ACROSS) - 2)
    assert fell[2:4, 2:6].min() > 1 and fell[0].abs().max() < 0.1


def test_other_exposure_reads_alike_and_mirrored_ground_reads_mirrored():
    rgb, places = ground(0.5)
    first = read(srgb_from_linear(0.1 * linear_from_srgb(rgb)), places)
    assert torch.allclose(first, read(srgb_from_linear(0.2 * linear_from_srgb(rgb)), places), atol=0.15)
    turned = read(rgb, places * torch.tensor([1.0, -1.0])).reshape(3, len(DOWN) - 2, len(ACROSS) - 2)
    assert torch.allclose(turned.flip(-1).flatten(), read(rgb, places), atol=1e-4)


def test_no_ground_in_reach_is_read_as_nothing():
    assert (read(torch.zeros(0, 3), torch.zeros(0, 2)) == 0).all()
    assert (read(torch.rand(9, 3), torch.full((9, 2), -1.0)) == 0).all()


def test_objects_read_together_read_as_each_alone():
    (rgb, places), few = ground(0.5), 400
    known = torch.ones(2, len(rgb), dtype=torch.bool)
    known[1, few:] = False
    both = read_ground(torch.stack([rgb, rgb.flip(0)]), torch.stack([places, places.flip(0)]), known)
    assert torch.allclose(both[0], read(rgb, places), atol=1e-5)
    assert torch.allclose(both[1], read(rgb.flip(0)[:few], places.flip(0)[:few]), atol=1e-5)


def test_it_learns_to_shade_what_lacks_a_shadow_and_only_that(tmp_path):
    street = torch.full((2, 80, 120, 3), 0.5)
    instance = torch.zeros(2, 80, 120, dtype=torch.uint8)
    instance[:, 30:50, 40:80] = 3
    shadow = torch.zeros(2, 80, 120)
    shadow[:, 50:54, 40:80] = 1
    right = street * (1 - 0.6 * shadow[..., None])
    noise = torch.rand(street.shape, generator=torch.Generator().manual_seed(0)) * 0.02
    tensors = {
        "input": to_bytes(street + noise), "target": to_bytes(right + noise), "region": to_bytes(shadow), "instance": instance,
        "flow": torch.zeros(2, 80, 120, 2, dtype=torch.float16), "visible": torch.ones(2, 80, 120, dtype=torch.uint8),
        "depth": torch.ones(2, 80, 120, dtype=torch.float16),
    }  # fmt: skip
    write_shard(tmp_path / "shadow" / "a.safetensors", tensors, {"kind": "shadow", "split": "train", "instances": [3]})
    sampler = ShadeSampler(PairSet(tmp_path).of("shadow"), seed=0)
    torch.manual_seed(0)
    net = ShadeNet(16)
    optimiser = torch.optim.Adam(net.parameters(), 5e-3)
    for step in range(150):
        drawn = sampler.draw(np.random.default_rng(step), 16)
        error = (shaded(drawn.given, optical_depth(drawn.places, net(drawn.read))) - drawn.target).square().mean((1, 2))
        optimiser.zero_grad()
        torch.log(error + 1e-3).mean().backward()
        optimiser.step()
    missing, there = ([one[0] for one in sampler.found[kind]] for kind in ("missing", "there"))
    with torch.no_grad():
        assert net(torch.stack(missing)).amax(1).min() > 0.3 and net(torch.stack(there)).amax() < 0.1


def test_without_clips_of_shadows_nothing_is_drawn():
    assert ShadeSampler([], seed=0).draw(np.random.default_rng(0), 4) is None
