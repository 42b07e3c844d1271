"""Noise and sharpening in excess, of whole pictures and of objects."""

from dataclasses import replace

import torch
from torch.nn import functional as F

from enhance.correcting.corrections import correct
from enhance.correcting.grain import Excess, Grain, of_object, sharpening, without
from enhance.correcting.objects import ObjectNet
from enhance.metrics import sharpness
from enhance.pairs.isp import Isp
from render.compare import psnr


def picture(seed: int = 0, height: int = 120, width: int = 160) -> torch.Tensor:
    """Lines and patches as a lens shows them: `[H, W, 3]`, soft by a pixel or so."""
    draw = torch.Generator().manual_seed(seed)
    rgb = torch.full((3, height, width), 0.45)
    for _ in range(60):
        y, x = (int(torch.randint(0, n - 30, (), generator=draw)) for n in (height, width))
        h, w = (int(torch.randint(2, 30, (), generator=draw)) for _ in range(2))
        rgb[:, y : y + h, x : x + w] = 0.15 + 0.6 * torch.rand(3, 1, 1, generator=draw)
    rgb = rgb + 0.02 * torch.randn(rgb.shape, generator=draw)  # plaster and leaves
    kernel = torch.tensor([0.25, 0.5, 0.25])
    kernel = (kernel[:, None] * kernel).expand(3, 1, 3, 3)
    return F.conv2d(F.pad(rgb[None], (1, 1, 1, 1), mode="replicate"), kernel, groups=3)[0].permute(1, 2, 0).contiguous()


def altered(rgb: torch.Tensor, **how) -> torch.Tensor:
    return Isp(**how)(rgb.permute(2, 0, 1)).permute(1, 2, 0)


RIGHT, NOISY, SHARP = picture(), altered(picture(), noise=0.04), altered(picture(), sharpen=1.2)


def test_noise_and_sharpening_are_told_from_each_other():
    draw = torch.Generator().manual_seed(1)
    added = RIGHT + 0.03 * torch.randn(RIGHT.shape, generator=draw)
    kept = 0.7613  # of white noise's variance, what a Gaussian of one pixel takes away: 1 - 2 / (2 pi) + 1 / (4 pi)
    noise = Excess.of(Grain.of(added), Grain.of(RIGHT))
    torch.testing.assert_close(noise.noise, torch.full((3,), kept * 0.03**2, dtype=torch.float64), rtol=0.25, atol=0)
    assert (noise.gain < 1.4).all()
    sharp = Excess.of(Grain.of(SHARP), Grain.of(RIGHT))
    assert (sharp.gain > 2).all() and (sharp.noise < 0.1 * noise.noise).all()
    assert not Excess.of(Grain.of(RIGHT), Grain.of(RIGHT)).any()


def test_a_picture_comes_back_without_what_it_has_in_excess():
    wanted = Grain.of(RIGHT)
    for spoilt, gains in ((NOISY, 2), (SHARP, 3)):
        better = without(spoilt, Excess.of(Grain.of(spoilt), wanted))
        assert psnr(better, RIGHT) > psnr(spoilt, RIGHT) + gains


def test_of_what_was_sharpened_the_finest_lines_are_as_fine_as_they_were():
    """Divided by what detail was multiplied with in the mean, they were left 1.85 times as sharp."""
    excess = Excess.of(Grain.of(SHARP), Grain.of(RIGHT))
    better = without(SHARP, replace(excess, noise=torch.zeros(3, dtype=torch.float64)))
    whole = torch.ones(RIGHT.shape[:2], dtype=torch.bool)
    spoilt, left = (sharpness(x, whole) / sharpness(RIGHT, whole) for x in (SHARP, better))
    assert spoilt > 3 and 0.9 < left < 1.6


def test_what_is_blurred_is_not_touched():
    blurred = F.avg_pool2d(F.pad(RIGHT.permute(2, 0, 1)[None], (1, 1, 1, 1), mode="replicate"), 3, 1)[0].permute(1, 2, 0)
    assert not Excess.of(Grain.of(blurred), Grain.of(RIGHT)).any()


def test_up_to_what_is_usual_there_is_no_excess():
    excess = Excess(torch.tensor([1.1, 1.5, 4.0]).double(), torch.tensor([1e-5, 2e-4, 1e-2]).double())
    usual = Excess(torch.full((3,), 1.5).double(), torch.full((3,), 2e-4).double())
    left = excess.beyond(usual)
    assert left.gain[:2].tolist() == [1, 1] and 3 < left.gain[2] < 4
    assert left.noise[:2].tolist() == [0, 0] and 0.95e-2 < left.noise[2] < 1e-2


def put_in(spoilt: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The right picture with an object of `spoilt`, `[3, H, W]`, and its ids."""
    ids = torch.zeros(RIGHT.shape[:2], dtype=torch.int32)
    ids[30:90, 40:110] = 3
    return torch.where(ids[..., None] > 0, spoilt, RIGHT).permute(2, 0, 1).contiguous(), ids


def test_objects_are_held_to_what_is_around_them():
    right, ids = put_in(RIGHT)
    for spoilt in (NOISY, SHARP):
        given, _ = put_in(spoilt)
        better, found = correct(ObjectNet(), given, ids, {})
        mask = ids > 0
        before, after = (psnr(x.permute(1, 2, 0), RIGHT, mask) for x in (given, better))
        assert after > before + 2 and torch.equal(better[:, ~mask], right[:, ~mask])
        for _ in range(12):  # steady, and looked at rarely
            better, found = correct(ObjectNet(), given, ids, found)
        assert psnr(better.permute(1, 2, 0), RIGHT, mask) > before + 2


def test_right_and_blurred_objects_stay_as_they_are():
    blurred = F.avg_pool2d(F.pad(RIGHT.permute(2, 0, 1)[None], (2, 2, 2, 2), mode="replicate"), 5, 1)[0].permute(1, 2, 0)
    for content in (RIGHT, blurred):
        given, ids = put_in(content)
        better = correct(ObjectNet(), given, ids, {})[0]
        assert psnr(better.permute(1, 2, 0), given.permute(1, 2, 0), ids > 0) > 48


def test_small_objects_and_flat_pictures_tell_nothing():
    mask = torch.zeros(RIGHT.shape[:2], dtype=torch.bool)
    mask[10:24, 10:30] = True
    assert of_object(NOISY, mask, ~mask) is None
    flat = torch.full((60, 80, 3), 0.5)
    mask = torch.zeros(60, 80, dtype=torch.bool)
    mask[10:50, 10:60] = True
    grain = of_object(flat, mask, ~mask)
    assert grain is not None and sharpening(*grain) == 0 and not Excess.of(*grain).any()
    noisy = torch.where(mask[..., None], altered(flat, noise=0.04), flat)  # a grey object on a grey wall
    grain = of_object(noisy, mask, ~mask)
    assert grain is not None
    better = without(noisy, Excess.of(*grain))
    assert torch.isfinite(better).all() and psnr(better, flat, mask) > psnr(noisy, flat, mask)
