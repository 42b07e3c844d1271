"""How sure must the network be before it changes anything? Chosen in training, so that clean pictures stay as they are."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import torch
from torch.nn import functional as F

from enhance.corrections import corrected
from enhance.net import MULTIPLE, Net, hard_gate
from enhance.precision import autocast
from enhance.shards import Shard, Window

CLEAN_DB = 49.0
"""PSNR that clean training pictures must keep against themselves. New places fare worse: drive 002's front camera by 7 dB."""
LEAST = (2.0, 0.5)
"""Least that may be chosen, without a mask and with one: a picture of which nothing is told may be any video, and right already."""
SHUTS = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0, 9.0, 15.0, 25.0, 40.0, 200.0, 1000.0)
PICTURES = 16

Changed = Callable[[torch.Tensor, torch.Tensor], Callable[[float], torch.Tensor]]
"""From a picture and its mask to what becomes of the picture at each shut."""


@torch.no_grad()
def calibrate_gate(net: Net, clean: Sequence[Shard]) -> None:
    """Set `net.shut`: the least of SHUTS, from LEAST, at which clean pictures keep CLEAN_DB, without a mask and with one."""

    def changed(rgb: torch.Tensor, told: torch.Tensor) -> Callable[[float], torch.Tensor]:
        mask = torch.where(told[:, 1:] > 0, told[:, :1], torch.nan)
        with autocast(rgb.device):
            out = net(rgb, mask)
        return lambda shut: rgb + hard_gate(out.logits, shut) * (out.ungated - rgb)

    _choose(net.shut, clean, changed, LEAST)


@torch.no_grad()
def repair_gain(net: Net, pairs: Sequence[Shard]) -> list[float]:
    """By how many dB of mean squared error `Net.repair` brings pairs nearer to their targets, beside what told objects
    are put right: without a mask and with one. 0 where there are no pairs."""
    gains = []
    for knowing in (0, 1):
        errors = [net.shut.new_zeros(2)]
        for shard in _spread(pairs):
            window, rgb, told = _picture(shard, knowing)
            rgb, told, target = rgb.to(net.shut.device), told.to(net.shut.device), window.target.to(net.shut.device)
            mask = torch.where(told[:, 1:] > 0, told[:, :1], torch.nan)
            rgb = corrected(net.objects, rgb, mask)
            with autocast(rgb.device):
                out = net(rgb, mask)
            right = F.pad(target, (0, rgb.shape[-1] - shard.width, 0, rgb.shape[-2] - shard.height), mode="replicate")
            errors.append(torch.stack([(x.clamp(0, 1) - right).square().mean() for x in (rgb, out.rgb)]))
        before, after = torch.stack(errors).sum(0).clamp_min(1e-12).tolist()
        gains.append(10 * math.log10(before / after))
    return gains


def _choose(pair: torch.Tensor, clean: Sequence[Shard], changed: Changed, least: Sequence[float]) -> None:
    """Write into `pair` the numbers for pictures without and, if it has two, with a mask; nothing where there are no clean pictures."""
    for knowing in range(len(pair)):
        errors = []
        for rgb, told in _pictures(clean, knowing):
            rgb, told = rgb.to(pair.device), told.to(pair.device)
            make = changed(rgb, told)
            errors.append(torch.stack([(make(shut) - rgb).square().mean() for shut in SHUTS]))
        if errors:
            good = torch.stack(errors).mean(0) <= 10 ** (-CLEAN_DB / 10)
            pair[knowing] = next((s for s, fine in zip(SHUTS, good.tolist(), strict=True) if fine and s >= least[knowing]), SHUTS[-1])


def _pictures(clean: Sequence[Shard], knowing: int) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
    """Pictures `[1, 3, H, W]` spread over the clips, sides padded for the network, and their masks with whether they are known."""
    for shard in _spread(clean):
        yield _picture(shard, knowing)[1:]


def _spread(shards: Sequence[Shard]) -> Sequence[Shard]:
    return shards[:: max(1, len(shards) // PICTURES)]


def _picture(shard: Shard, knowing: int) -> tuple[Window, torch.Tensor, torch.Tensor]:
    """A clip's middle frame; as the network takes it, and its mask with whether that is known."""
    window = shard.window(shard.frames // 2, 1)
    pad = (0, -shard.width % MULTIPLE, 0, -shard.height % MULTIPLE)
    mask = F.pad((window.instance > 0).float(), pad) * knowing
    return window, F.pad(window.input, pad, mode="replicate"), torch.cat([mask, torch.full_like(mask, float(knowing))], 1)
