"""The accuracy benchmark's figures mean what they say."""

import math

import pytest
import torch

from tests.bench.accuracy import charts, cloud, errors, exp_errors, monte_carlo, rows, table, ut_in_pixels
from tests.oracle import project_ewa


def test_errors_of_a_known_difference():
    truth = torch.zeros(10, 100, 3, dtype=torch.float64)
    picture = truth.clone()
    picture[0, 0, 0] = 0.1
    found = errors(picture, truth)
    assert found["max"] == pytest.approx(0.1) and found["p99.9"] == 0.0
    assert found["psnr"] == pytest.approx(10 * math.log10(3000 / 0.01))


def test_every_knob_is_measured_and_its_error_falls_as_it_is_turned():
    found = rows(cloud(48, 32, 300), lambda work: 1.0)
    assert table(found).count("\n") == len(found) + 1 and len(charts(found, "cloud")) == 2
    for knob in ("cutoff", "termination", "max_error", "SH degree"):
        largest = [r["max"] for r in found if r["knob"] == knob]
        assert len(largest) > 2 and largest == sorted(largest, reverse=True), knob
    exact = next(r for r in found if r["knob"] == "float32")
    assert exact["max"] < 2e-5


def test_float32_puts_centres_at_4k_within_a_thousandth_of_a_pixel():
    assert ut_in_pixels(2000)["p99"] < 1e-3


def test_exp_is_as_exact_as_the_budget_says():
    assert all(e["absolute"] < 3e-6 for e in exp_errors())


def test_monte_carlo_of_a_small_far_splat_is_its_linearization():
    axes = torch.diag(torch.tensor([0.02, 0.01, 0.02], dtype=torch.float64))[None]
    point = torch.tensor([[0.5, -0.2, 5.0]], dtype=torch.float64)
    lens = torch.tensor([100.0, 100.0, 50.0, 50.0], dtype=torch.float64)
    mean, covariance, with_depth = monte_carlo(point, axes, lens, 100, 100, samples=40_000)
    there, linear, along = project_ewa(point, axes @ axes.transpose(1, 2), lens, 100, 100)
    assert (mean - there).abs().max() < 0.01
    assert (covariance / linear - 1).abs()[0].diagonal().max() < 0.03
    assert (with_depth / along - 1).abs()[0, 0] < 0.03  # the other is a third as large, and as noisy
