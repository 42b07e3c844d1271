"""What repairing gains is measured apart for frames alone and beside photos."""

from types import SimpleNamespace

import torch
from small_net import SMALL, stirred

from enhance.network.net import Net, photos_of
from enhance.network.weights_file import REPAIR_GAIN
from enhance.training import train
from enhance.training.gain import repair_gain


def shard(given, target, kind="sparse", reference=None, trust=0.0):
    """A clip of one frame `[3, H, W]`."""
    some = torch.full((1, 1, *given.shape[1:]), trust)
    window = SimpleNamespace(
        input=given[None], target=target[None], reference=(given if reference is None else reference)[None], trust=some
    )
    meta = {"kind": kind}
    return SimpleNamespace(frames=1, height=given.shape[1], width=given.shape[2], meta=meta, window=lambda *_: window)


def picture(seed=0):
    return 0.2 + 0.6 * torch.rand(3, 32, 48, generator=torch.Generator().manual_seed(seed))


def test_repairing_gains_where_it_leads_to_the_target_and_loses_where_it_leads_away():
    net, given = stirred(), picture()
    better = net(given[None]).rgb[0].clamp(0, 1).detach()
    half_way = given + (better - given) / 2
    assert (better - given).abs().max() > 1e-3
    assert repair_gain(net, [shard(given, better)])[0] > 20 and repair_gain(net, [shard(given, given - (better - given))])[0] < -3
    assert abs(repair_gain(net, [shard(given, half_way)])[0]) < 0.5
    assert repair_gain(Net(SMALL), [shard(given, better)]) == [0.0, 0.0] == repair_gain(net, [])


def test_what_photos_say_is_laid_in_and_told_before_the_gain_is_measured():
    net, given, seen = stirred(), picture(), picture(1)
    trust = torch.full((1, 1, 32, 48), 0.5)
    both = torch.lerp(given[None], seen[None], trust)
    better = net(both, photos=photos_of(seen[None], trust)).rgb[0].clamp(0, 1).detach()
    alone, beside = repair_gain(net, [shard(given, better, reference=seen, trust=0.5)])
    assert beside > 20 > alone


def test_kinds_count_alike_however_many_clips_they_have():
    net, given = stirred(), picture()
    better = net(given[None]).rgb[0].clamp(0, 1).detach()
    good, bad = shard(given, better), shard(given, given - (better - given), "underfit")
    few, many = (repair_gain(net, [good, *[bad] * n])[0] for n in (1, 5))
    assert abs(few - many) < 1e-4
    told = []
    repair_gain(net, [good, bad, bad], lambda done, of: told.append((done, of)))
    assert told == [(1, 3), (2, 3), (3, 3)]


def test_clips_that_are_held_out_judge_and_trained_ones_where_none_is(monkeypatch):
    """On clips that a network was trained on it gains by knowing the place."""
    clips = [SimpleNamespace(meta={"kind": "sparse", "split": split}) for split in ("train", "held out", "train")]
    judged = []
    monkeypatch.setattr(train, "repair_gain", lambda _, shards, *__: judged.append([s.meta["split"] for s in shards]) or [1.0, 1.0])
    run = SimpleNamespace(stages=["enhancer"], average=None)
    for some in (clips, clips[::2]):
        assert train._gain(run, SimpleNamespace(of=lambda some=some: some), None, lambda *_: None) == {REPAIR_GAIN: [1.0, 1.0]}
    assert judged == [["held out"], ["train", "train"]]
