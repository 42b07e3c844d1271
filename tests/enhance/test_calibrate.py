"""How sure the network must be is the least that keeps clean pictures clean."""

import torch

from enhance import calibrate
from enhance.calibrate import CLEAN_DB, LEAST, SHUTS


def chosen(monkeypatch, error, pictures=2):
    """What is chosen where a picture is off by `error(shut)`, without a mask and with one."""
    rgb = torch.full((1, 3, 16, 16), 0.5)
    monkeypatch.setattr(calibrate, "_pictures", lambda clean, knowing: [(rgb, torch.full((1, 2, 16, 16), float(knowing)))] * pictures)
    pair = torch.tensor([-1.0, -1.0])
    calibrate._choose(pair, [], lambda rgb, told: lambda shut: rgb + error(shut, bool(told.max() > 0)))
    return pair.tolist()


def test_the_least_that_is_clean_enough_is_chosen_for_each_mask(monkeypatch):
    limit, least = 10 ** (-CLEAN_DB / 20), [SHUTS[5], SHUTS[3]]
    assert chosen(monkeypatch, lambda shut, told: limit * (0.9 if shut >= least[told] else 1.1)) == least
    assert chosen(monkeypatch, lambda shut, told: 0.0) == [*LEAST]


def test_where_nothing_is_clean_enough_the_surest_is_chosen(monkeypatch):
    assert chosen(monkeypatch, lambda shut, told: 0.5) == [SHUTS[-1]] * 2


def test_without_clean_pictures_nothing_is_chosen(monkeypatch):
    assert chosen(monkeypatch, lambda shut, told: 0.0, pictures=0) == [-1.0, -1.0]
