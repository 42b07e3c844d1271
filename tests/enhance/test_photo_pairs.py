"""Pairs of photos alone."""

import sys
import weakref
from pathlib import Path

import pytest
import torch

from enhance.pairs.of_photos import make_photo_pairs
from enhance.pairs.shards import PairSet
from enhance.photos import frames_of, photos_of
from render.video import write_image


def test_photos_become_pairs_that_are_held_out_and_told_their_region(tmp_path):
    (tmp_path / "photos").mkdir()
    for i in range(3):
        write_image(tmp_path / "photos" / f"{i}.png", torch.rand(60, 80, 3, generator=torch.Generator().manual_seed(i)))
    pairs = PairSet(make_photo_pairs([tmp_path / "photos"], tmp_path / "made", seed=2, width=64))
    assert len(pairs.of("isp", "held out")) == len(pairs.of("clean", "held out")) == 3 and not pairs.of(split="train")
    for altered, right in zip(pairs.of("isp"), pairs.of("clean"), strict=True):
        a, b = altered.window(), right.window()
        assert torch.equal(b.input, b.target) and torch.equal(a.target, b.target) and b.region.max() == 0
        changed = (a.input != a.target).any(1, keepdim=True)
        assert changed.any() and not changed[a.region == 0].any()
        assert torch.equal(a.instance, b.instance) and ((a.instance == 1) == (a.region > 0.5)).float().mean() > 0.99


def test_pairs_of_photos_go_on_where_they_stopped(tmp_path):
    (tmp_path / "photos").mkdir()
    for i in range(3):
        write_image(tmp_path / "photos" / f"{i}.png", torch.rand(60, 80, 3, generator=torch.Generator().manual_seed(i)))

    def made() -> dict[Path, tuple[int, bytes]]:
        out = make_photo_pairs([tmp_path / "photos"], tmp_path / "made", width=64)
        return {file: (file.stat().st_mtime_ns, file.read_bytes()) for file in out.glob("*/*.safetensors")}

    before = made()
    (tmp_path / "made" / "isp_frame" / "photos_0001.json").unlink()
    after = made()
    assert {file for file in before if before[file][0] != after[file][0]} == {f for f in before if f.stem == "photos_0001"}
    assert len(before) == 9 and all(before[file][1] == after[file][1] for file in before)
    write_image(tmp_path / "photos" / "2.png", torch.zeros(60, 80, 3))
    with pytest.raises(ValueError, match="holds pairs of another source photos, or of this one before it was changed"):
        made()


def test_pairs_of_photos_hold_one_photo_at_a_time(tmp_path, monkeypatch):
    """A long video has no room in memory."""
    (tmp_path / "photos").mkdir()
    for i in range(5):
        write_image(tmp_path / "photos" / f"{i}.png", torch.rand(32, 48, 3))
    module, given = sys.modules["enhance.pairs.of_photos"], []

    def watched(*asked):
        for photo in photos_of(*asked):
            assert sum(one() is not None for one in given) <= 1  # the one before, which a loop still names
            given.append(weakref.ref(photo))
            yield photo

    monkeypatch.setattr(module, "photos_of", watched)
    assert len(PairSet(make_photo_pairs([tmp_path / "photos"], tmp_path / "made", width=48)).of("isp")) == 5 and len(given) == 10


def test_what_a_mac_leaves_among_photos_is_none(tmp_path):
    write_image(tmp_path / "0.png", torch.rand(32, 48, 3))
    (tmp_path / "._0.png").write_bytes(b"Mac OS X")
    assert len(list(frames_of(tmp_path, 1))) == 1
