"""Other light."""

import numpy as np
import pytest
import torch
from street import sky, street

from enhance.pairs.lighting import Illumination, random_sky, relit, smoothed, under
from scenes.light import sun_of_sky

UP = torch.tensor([0.0, 0.0, 1.0])


def lit_from(*direction):
    towards = torch.nn.functional.normalize(torch.tensor([direction], dtype=torch.float64), dim=1)
    return Illumination(towards, torch.ones(1, 3, dtype=torch.float64))


@pytest.mark.parametrize("seed", range(4))
def test_level_ground_gets_one_unit_of_any_light(seed):
    light = Illumination.of(under(street(), random_sky(np.random.default_rng(seed))))
    luminance = light.on(UP).double() @ torch.tensor([0.2126, 0.7152, 0.0722], dtype=torch.float64)
    assert abs(float(luminance) - 1) < 0.1  # but for what comes from lower than LEVEL


def test_the_side_towards_the_sun_is_brighter():
    on = lit_from(1.0, 0.0, 1.0).on(torch.tensor([[1.0, 0, 0], [-1.0, 0, 0]]))
    assert (on[0] > 3 * on[1]).all() and (on[1] > 0).all()


def test_the_same_light_changes_nothing_and_the_mask_is_kept():
    rgb, mask = torch.rand(6, 8, 3), torch.zeros(6, 8)
    mask[2:5, 2:6] = 1
    normals = UP.expand(6, 8, 3)
    assert torch.allclose(relit(rgb, normals, mask, lit_from(1, 0, 1), lit_from(1, 0, 1), 1.0), rgb, atol=1e-5)
    other = relit(rgb, normals, mask, lit_from(1, 0, 1), lit_from(1, 0, 1), 0.5)
    assert torch.equal(other[mask == 0], rgb[mask == 0]) and (other[mask > 0] < rgb[mask > 0]).all()
    soft = relit(rgb, normals, mask / 4, lit_from(1, 0, 1), lit_from(1, 0, 1), 0.5)
    torch.testing.assert_close(soft, rgb + (other - rgb) / 4, atol=1e-6, rtol=0)


def test_relighting_there_and_back_is_the_photo():
    rgb, mask = 0.3 + 0.3 * torch.rand(4, 4, 3), torch.ones(4, 4)
    normals = torch.nn.functional.normalize(torch.rand(4, 4, 3) + 0.2, dim=-1)
    a, b = lit_from(1, 0.3, 1), lit_from(0.4, 1, 1)
    assert torch.allclose(relit(relit(rgb, normals, mask, a, b, 1.0), normals, mask, b, a, 1.0), rgb, atol=1e-4)


def test_smoothing_keeps_a_plane_and_stays_within_the_mask():
    mask = torch.zeros(40, 40)
    mask[5:35, 5:35] = 1
    tilted = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, 2.0]), dim=0)
    normals = torch.where(mask[..., None] > 0, tilted, -UP)
    assert torch.allclose(smoothed(normals, mask)[mask > 0], tilted, atol=1e-5)


def test_made_up_skies_differ_and_some_have_a_sun():
    made = [random_sky(np.random.default_rng(i)) for i in range(12)]
    assert torch.equal(made[3].linear, random_sky(np.random.default_rng(3)).linear)
    assert 3 <= sum(sun_of_sky(s) is not None for s in made) <= 11
    assert all(torch.isfinite(s.linear).all() and (s.linear > 0).all() for s in made)


def test_a_given_sky_is_turned_round():
    given = sky()
    turned = [random_sky(np.random.default_rng(i), [given]) for i in range(6)]
    assert any(t.linear.shape == given.linear.shape for t in turned)
