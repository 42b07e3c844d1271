"""What repairing is worth: measured at the end of training, so that a network that gains too little is not run."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

import torch
from torch.nn import functional as F

from enhance.network.net import MULTIPLE, Net, photos_of
from enhance.network.precision import autocast
from enhance.pairs.shards import Shard
from render.compare import decibels
from scenes.spread import spread

CLIPS = 32
"""Clips of a kind that are looked at, at most, spread over all."""


@torch.no_grad()
def repair_gain(net: Net, rendered: Sequence[Shard], progress: Callable[[int, int], None] | None = None) -> list[float]:
    """By how many dB `Net.repair` brings clips' middle frames nearer to their targets, the mean over kinds: alone, and beside what photos
    say. 0 where there are no clips. `progress` is called with how many clips were looked at, and of how many."""
    by_kind = defaultdict(list)
    for shard in rendered:
        by_kind[shard.meta["kind"]].append(shard)
    if not by_kind:
        return [0.0, 0.0]
    chosen = {kind: spread(shards, CLIPS) for kind, shards in by_kind.items()}
    count = sum(map(len, chosen.values()))
    means: list[list[list[float]]] = []
    done = 0
    for shards in chosen.values():
        means.append([])
        for shard in shards:
            means[-1].append(_gains(net, shard))
            done += 1
            if progress is not None:
                progress(done, count)
    return torch.stack([torch.tensor(of_kind).mean(0) for of_kind in means]).mean(0).tolist()


def _gains(net: Net, shard: Shard) -> list[float]:
    device = next(net.parameters()).device
    window = shard.window(shard.frames // 2, 1)
    pad = (0, -shard.width % MULTIPLE, 0, -shard.height % MULTIPLE)
    rendered, target, reference = (F.pad(x, pad, mode="replicate").to(device) for x in (window.input, window.target, window.reference))
    gains = []
    for trust in (torch.zeros_like(window.trust), window.trust):
        trust = F.pad(trust, pad).to(device)
        given = torch.lerp(rendered, reference, trust)
        with autocast(device):
            better = net(given, photos=photos_of(reference, trust)).rgb
        before, after = (decibels(max(1e-12, float((x.clamp(0, 1) - target).square().mean()))) for x in (given, better))
        gains.append(after - before)
    return gains
