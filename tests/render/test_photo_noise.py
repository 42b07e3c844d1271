"""A photo's noise, told from what splats do not explain of it."""

from __future__ import annotations

import pytest
import torch

from render.photo_noise import BRIGHTNESSES, noise_of, without_noise


def _ramp() -> torch.Tensor:
    """A picture `[192, 256, 3]` from dark to bright."""
    return torch.linspace(0.05, 0.9, 256)[None, :, None].expand(192, 256, 3).contiguous()


def _grain(spread: torch.Tensor | float) -> torch.Tensor:
    return torch.randn(192, 256, 3, generator=torch.Generator().manual_seed(1)) * spread


def test_noise_is_told_by_brightness() -> None:
    """Noise of 8 levels in the dark and 2 in the bright."""
    photo = _ramp()
    noise = noise_of(_grain((8 - 6 * photo) / 255), photo)
    assert noise is not None and len(noise) == BRIGHTNESSES
    middles = (torch.arange(BRIGHTNESSES) + 0.5) / BRIGHTNESSES
    expected = 8 - 6 * middles.clamp(0.05, 0.9)
    assert noise.sqrt() * 255 == pytest.approx(expected.numpy(), rel=0.15)
    assert (noise.diff() <= 0).all()


def test_noise_goes_and_an_edge_stays() -> None:
    photo, edge = _ramp(), torch.zeros(192, 256, 3)
    edge[:, 64:66], edge[100:102] = 0.3, -0.2
    kept = without_noise(edge + _grain(0.03), photo)
    flat = torch.ones(192, 256, dtype=torch.bool)
    flat[:, 60:70], flat[96:106] = False, False
    assert kept[flat].std() < 0.3 * 0.03
    assert kept[:90, 64:66].mean() == pytest.approx(0.3, rel=0.1) and kept[100:102, 80:].mean() == pytest.approx(-0.2, rel=0.1)


def test_what_splats_blur_is_no_noise() -> None:
    """Texture in half of the picture, and nothing in the other half: the texture is kept as it is."""
    photo, texture = _ramp(), _grain(0.06)
    texture[96:] = 0
    assert torch.equal(without_noise(texture, photo), texture)


def test_bright_texture_is_no_noise() -> None:
    """Where only the bright half is full of texture, the dark tells that it is no noise."""
    photo, texture = _ramp(), _grain(0.06)
    texture[:, :128] *= 0.1
    kept = without_noise(texture, photo)
    assert (kept[:, 160:] / texture[:, 160:]).median() > 0.95


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_clipped_pictures_tell_nothing(level: float) -> None:
    photo = torch.full((192, 256, 3), level)
    assert noise_of(_grain(0.02), photo) is None


def test_a_picture_too_small_to_tell_is_left_alone() -> None:
    difference = _grain(0.05)[:20, :20]
    assert torch.equal(without_noise(difference, _ramp()[:20, :20]), difference)
    assert torch.equal(without_noise(difference[:5, :5], _ramp()[:5, :5]), difference[:5, :5])
