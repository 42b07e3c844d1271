"""Tiles: where there is nothing to do, nothing is done."""

from dataclasses import replace

import pytest
import torch
from small_net import stirred
from torch.nn import functional as F

from enhance.enhancer import Enhancer
from enhance.network.net import Net
from enhance.tiles import TILE, Tiles
from render.frame_types import Frame
from scenes.camera import Camera
from scenes.lenses import Pinhole

H, W = 150, 330


def picture(seed=0, h=H, w=W):
    coarse = torch.rand(1, 3, h // 10, w // 10, generator=torch.Generator().manual_seed(seed))
    return F.interpolate(coarse, (h, w), mode="bilinear")[0].permute(1, 2, 0).contiguous()


def frame(rgb, **more):
    h, w = rgb.shape[:2]
    return Frame(Camera(Pinhole(50.0, 50.0, w / 2, h / 2), w, h, torch.eye(4, dtype=torch.float64)), rgb=rgb, **more)


def need_at(*places):
    need = torch.zeros(H, W)
    for y, x in places:
        need[y : y + 20, x : x + 20] = 1
    return need


@pytest.fixture(scope="module")
def enhancer():
    return Enhancer(stirred())


def test_tiles_are_those_whose_cells_need_something_and_single_pixels_do_not_count():
    need = need_at((40, 100))
    need[140, 300] = 1
    tiles = Tiles.of(need)
    assert tiles.needed.shape == (5, 11) and tiles.needed.sum() == 1 and tiles.needed[1, 3]
    assert tiles.pixels().shape == (H, W) and int(tiles.pixels().sum()) == TILE * TILE


def test_windows_hold_their_tiles_with_a_margin_and_far_ones_are_apart():
    near, far = Tiles.of(need_at((40, 100), (40, 132))), Tiles.of(need_at((10, 10), (100, 290)))
    assert len(near.windows()) == 1 and len(far.windows()) == 2
    whole = (slice(0, 96), slice(64, 192))
    assert near.windows()[0] == (whole, whole)
    assert Tiles.of(torch.ones(H, W)).everything() and Tiles.of(torch.zeros(H, W)).nothing() and not far.everything()


def test_a_frame_that_needs_nothing_comes_back_bit_by_bit_and_costs_no_network(enhancer, monkeypatch):
    _, memory = enhancer.step(frame(picture()))
    monkeypatch.setattr(Net, "repair", None)
    rgb = picture(1)
    better, after = enhancer.step(frame(rgb, need=torch.zeros(H, W)), memory)
    assert torch.equal(better, rgb) and after.past is memory.past


def test_tiles_that_need_nothing_come_back_bit_by_bit(enhancer):
    rgb, need = picture(), need_at((10, 10), (100, 290))
    better, _ = enhancer.step(frame(rgb, need=need))
    pixels = Tiles.of(need).pixels()
    assert torch.equal(better[~pixels], rgb[~pixels]) and not torch.equal(better[pixels], rgb[pixels])


def test_what_needs_everything_is_the_frame_without_a_need_map(enhancer):
    whole, _ = enhancer.step(frame(picture()))
    same, _ = enhancer.step(frame(picture(), need=torch.ones(H, W)))
    assert torch.equal(whole, same)


def test_where_nobody_knows_there_may_be_need(enhancer):
    whole, _ = enhancer.step(frame(picture()))
    same, _ = enhancer.step(frame(picture(), need=torch.full((H, W), torch.nan)))
    assert torch.equal(whole, same)


def test_a_tile_is_about_as_the_whole_frame_has_it(enhancer):
    rgb, need = picture(), need_at((40, 100), (70, 160))
    memory = enhancer.step(frame(rgb))[1]
    whole, _ = enhancer.step(frame(rgb), memory)
    some, _ = enhancer.step(frame(rgb, need=need), memory)
    pixels = Tiles.of(need).pixels()
    changed = (whole - rgb).abs()[pixels].mean()
    assert (some - whole).abs()[pixels].mean() < 0.5 * changed


def test_only_what_was_worked_on_is_remembered(enhancer):
    _, memory = enhancer.step(frame(picture(), need=need_at((40, 100))))
    known = memory.past.valid[0, 0, 0] > 0
    assert known[5, 13] and not known[15, 40] and known.sum() == 12 * 12
    assert (memory.past.seen == 1).all()


def test_frames_that_need_nothing_are_made_up_for_by_their_flow(enhancer):
    """Two skipped frames that each move 8 pixels leave the memory where one worked on after them finds it: 24 pixels on."""
    rgb, none, flow = picture(), torch.zeros(H, W), torch.zeros(H, W, 2)
    flow[..., 0] = -8
    memory = enhancer.step(frame(rgb))[1]
    for _ in range(2):
        _, memory = enhancer.step(frame(rgb, need=none, flow_prev=flow), memory)
    moved, _ = enhancer.step(frame(rgb.roll(24, 1), flow_prev=flow), memory)
    at_once, _ = enhancer.step(frame(rgb.roll(24, 1), flow_prev=3 * flow), enhancer.step(frame(rgb))[1])
    assert (moved - at_once)[:, 30:].abs().max() < 0.02


def test_flows_of_skipped_frames_are_followed_in_their_order(enhancer):
    """What a flow does not know of is forgotten where it is then, and moves on with the next flow."""
    rgb, none = picture(), torch.zeros(H, W)
    hole, on = torch.zeros(H, W, 2), torch.zeros(H, W, 2)
    hole[:, 32:64], on[..., 0] = torch.nan, -64
    memory = enhancer.step(frame(rgb))[1]
    for flow in (hole, on):
        _, memory = enhancer.step(frame(rgb, need=none, flow_prev=flow), memory)
    past = memory.past.moved(memory.since[0]).moved(memory.since[1])
    assert not past.seen[..., 96:128].any() and past.seen[..., :H, 130:300].all()
    now = frame(rgb.roll(64, 1), flow_prev=torch.zeros(H, W, 2))
    assert torch.equal(enhancer.step(now, memory)[0], enhancer.step(now, replace(memory, past=past, since=()))[0])


def test_after_many_frames_that_need_nothing_there_is_no_past(enhancer):
    rgb, none, flow = picture(), torch.zeros(H, W), torch.zeros(H, W, 2)
    memory = enhancer.step(frame(rgb, flow_prev=flow))[1]
    for _ in range(6):
        _, memory = enhancer.step(frame(rgb, need=none, flow_prev=flow), memory)
    assert memory.past is None
    assert torch.equal(enhancer.step(frame(rgb, flow_prev=flow), memory)[0], enhancer.step(frame(rgb))[0])


def test_large_frames_are_worked_on_in_parts_that_cover_every_pixel_once():
    tiles = Tiles(torch.ones(68, 120, dtype=torch.bool).numpy(), 2160, 3840)  # 4K
    count = torch.zeros(68 * TILE, 120 * TILE, dtype=torch.int32)
    for window, core in tiles.windows():
        count[core] += 1
        assert all(w.start <= c.start and c.stop <= w.stop and w.stop - w.start <= 42 * TILE for w, c in zip(window, core, strict=True))
    assert (count == 1).all() and not tiles.everything() and len(tiles.windows()) == 6


def test_parts_of_a_large_frame_are_about_the_whole(enhancer, monkeypatch):
    rgb = picture()
    memory = enhancer.step(rgb)[1]
    whole, _ = enhancer.step(rgb, memory)
    monkeypatch.setattr("enhance.tiles.LARGEST", 6)
    parts, after = enhancer.step(rgb, memory)
    assert not torch.equal(parts, whole) and (parts - whole).abs().mean() < 0.3 * (whole - rgb).abs().mean()
    assert (after.past.valid[0, 0] == 1).all()
