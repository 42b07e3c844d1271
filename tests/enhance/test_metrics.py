"""What the tables measure."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_net import SMALL, stirred

from enhance.drift import drift, of_video
from enhance.enhancer import Enhancer
from enhance.evaluate import HIGHEST, measured
from enhance.metrics import feature_distance, interval, region_ssim, sharpness, warp_error
from enhance.network.net import Net
from enhance.pairs.shards import PairSet, write_shard
from render.compare import ssim
from render.video import VideoWriter


def picture(seed=0, h=48, w=64):
    return torch.rand(h, w, 3, generator=torch.Generator().manual_seed(seed))


def test_the_ssim_of_the_whole_region_is_the_frames():
    a, b = picture(0), picture(1)
    whole = torch.ones(48, 64, dtype=torch.bool)
    assert abs(region_ssim(a, b, whole) - ssim(a, b)) < 1e-6


def test_what_lies_outside_the_region_does_not_count():
    target, region = picture(), torch.zeros(48, 64, dtype=torch.bool)
    region[10:30, 10:40] = True
    better = target.clone()
    better[40:, 50:] = 0
    assert region_ssim(better, target, region) == pytest.approx(1, abs=1e-6)
    features = stirred().requires_grad_(False).encoder.features
    far = torch.zeros(48, 64, dtype=torch.bool)
    far[:4, :4] = True
    assert feature_distance(better, target, far, lambda x: features(x)[:1]) < feature_distance(
        better, target, ~region, lambda x: features(x)[:1]
    )


def test_equal_pictures_have_no_distance_and_any_size_is_taken():
    features = stirred().requires_grad_(False).encoder.features
    rgb = picture(h=45, w=61)
    assert feature_distance(rgb, rgb, torch.ones(45, 61), lambda x: features(x)[:2]) == 0


def test_a_pictures_border_is_no_edge():
    whole = torch.ones(20, 30, dtype=torch.bool)
    assert sharpness(torch.full((20, 30, 3), 0.5), whole) < 1e-12
    ramp = torch.linspace(0, 1, 30)[None, :, None].expand(20, 30, 3)
    assert sharpness(ramp, whole) < 1e-3


def test_smoothing_costs_sharpness():
    rgb, whole = picture(), torch.ones(48, 64, dtype=torch.bool)
    smooth = torch.nn.functional.avg_pool2d(rgb.permute(2, 0, 1)[None], 3, 1, 1)[0].permute(1, 2, 0)
    assert sharpness(smooth, whole) < 0.5 * sharpness(rgb, whole)


def test_a_picture_that_moves_with_its_flow_does_not_flicker():
    rgb = picture()
    moved, flow = rgb.roll(2, 1), torch.zeros(2, 48, 64)
    flow[0] = -2
    seen = torch.ones(1, 48, 64)
    error = warp_error(moved, rgb, flow, seen)
    assert error is not None and error < 0.1 and warp_error(rgb, rgb, flow, seen) > 10
    assert warp_error(moved, rgb, flow, 0 * seen) is None


def test_the_interval_holds_the_mean_and_leaves_out_what_is_unknown():
    values = [*np.random.default_rng(0).normal(1, 0.5, 40), float("nan")]
    low, high = interval(values)
    assert low < np.nanmean(values) < high
    assert high - low == pytest.approx(2 * 1.96 * np.nanstd(values) / 40**0.5, rel=0.08), "as a normal mean's 95 percent"
    assert np.isnan(interval([1.0])).all()


def test_a_row_tells_the_region_apart_and_what_flickers_where_the_frame_before_was_seen(tmp_path):
    """Of a clip whose second frame is 26 levels off in a fifth of it, and right elsewhere."""
    right = torch.randint(40, 200, (40, 50, 3), generator=torch.Generator().manual_seed(0), dtype=torch.uint8).repeat(2, 1, 1, 1)
    given, region, visible = right.clone(), torch.zeros(2, 40, 50, dtype=torch.uint8), torch.zeros(2, 40, 50, dtype=torch.uint8)
    given[1, 10:30, 10:30] += 26
    region[:, 10:30, 10:30], visible[:, :, :25] = 255, 1
    flow, depth = torch.zeros(2, 40, 50, 2, dtype=torch.float16), torch.ones(2, 40, 50, dtype=torch.float16)
    tensors = {
        "input": given,
        "target": right,
        "region": region,
        "instance": region.clone(),
        "flow": flow,
        "visible": visible,
        "depth": depth,
    }
    write_shard(tmp_path / "isp" / "a_0000.safetensors", tensors, {"kind": "isp", "split": "held out"})
    row = measured("isp", "identity", PairSet(tmp_path).shards, Enhancer(Net(SMALL)), lambda rgb: [rgb])
    off = 20 * math.log10(255 / 26)
    assert row.mean("region") == pytest.approx((HIGHEST + off) / 2, abs=1e-3)
    assert row.mean("frame") == pytest.approx((HIGHEST + off + 10 * math.log10(5)) / 2, abs=1e-3)
    assert row.mean("warp error") == pytest.approx(26 * 300 / 1000, abs=1e-3)
    perfect = replace(row, clips=row.clips | {"region": [math.inf]})
    assert perfect.gain(row) == [HIGHEST - row.mean("region")] and perfect.mean("region") == math.inf


def test_the_identity_does_not_drift_and_a_stirred_network_may(tmp_path):
    with VideoWriter(tmp_path / "v.mp4", 10, 48, 32) as video:
        for i in range(5):
            video.write(picture(i, 32, 48))
    still = drift(Enhancer(Net(SMALL)), of_video(tmp_path / "v.mp4"), frames=20)
    assert max(still.brightness, still.colour, still.sharpness) < 1e-6
    other = drift(Enhancer(stirred()), of_video(tmp_path / "v.mp4"), frames=20)
    assert np.isfinite([other.brightness, other.colour, other.sharpness]).all()


def test_a_long_clips_rollout_comes_back_to_where_it_began():
    """Or its first frames would be compared with themselves."""
    from types import SimpleNamespace

    generator = torch.Generator().manual_seed(3)
    pictures = [torch.rand(8, 8, 3, generator=generator) for _ in range(40)]
    fading = SimpleNamespace(step=lambda rgb, memory: (rgb * 0.99 ** (memory or 0), (memory or 0) + 1))
    assert drift(fading, pictures, frames=30).brightness > 10
