"""How sure the network must be is the least that keeps clean pictures clean."""

from types import SimpleNamespace

import torch
from small_net import SMALL, stirred

from enhance import calibrate
from enhance.calibrate import CLEAN_DB, LEAST, SHUTS, repair_gain
from enhance.net import Net


def chosen(monkeypatch, error, pictures=2):
    """What is chosen where a picture is off by `error(shut)`, without a mask and with one."""
    rgb = torch.full((1, 3, 16, 16), 0.5)
    monkeypatch.setattr(calibrate, "_pictures", lambda clean, knowing: [(rgb, torch.full((1, 2, 16, 16), float(knowing)))] * pictures)
    pair = torch.tensor([-1.0, -1.0])
    calibrate._choose(pair, [], lambda rgb, told: lambda shut: rgb + error(shut, bool(told.max() > 0)), LEAST)
    return pair.tolist()


def test_the_least_that_is_clean_enough_is_chosen_for_each_mask(monkeypatch):
    limit, least = 10 ** (-CLEAN_DB / 20), [SHUTS[5], SHUTS[3]]
    assert chosen(monkeypatch, lambda shut, told: limit * (0.9 if shut >= least[told] else 1.1)) == least
    assert chosen(monkeypatch, lambda shut, told: 0.0) == [*LEAST]


def test_where_nothing_is_clean_enough_the_surest_is_chosen(monkeypatch):
    assert chosen(monkeypatch, lambda shut, told: 0.5) == [SHUTS[-1]] * 2


def test_without_clean_pictures_nothing_is_chosen(monkeypatch):
    assert chosen(monkeypatch, lambda shut, told: 0.0, pictures=0) == [-1.0, -1.0]


def shard(given, target):
    """A clip of one frame `[3, H, W]`, without objects."""
    window = SimpleNamespace(input=given[None], target=target[None], instance=torch.zeros(1, 1, *given.shape[1:]))
    return SimpleNamespace(frames=1, height=given.shape[1], width=given.shape[2], window=lambda *_: window)


def test_repairing_gains_where_it_leads_to_the_target_and_loses_where_it_leads_away():
    net, given = stirred(), 0.2 + 0.6 * torch.rand(3, 32, 48, generator=torch.Generator().manual_seed(0))
    net.shut.fill_(0.1)
    untold = net(given[None]).rgb[0].clamp(0, 1).detach()
    half_way = given + (untold - given) / 2
    assert (untold - given).abs().max() > 1e-3
    assert repair_gain(net, [shard(given, untold)])[0] > 20 and repair_gain(net, [shard(given, given - (untold - given))])[0] < -3
    assert abs(repair_gain(net, [shard(given, half_way)])[0]) < 0.5
    assert repair_gain(Net(SMALL), [shard(given, untold)]) == [0.0, 0.0] == repair_gain(net, [])
