"""The kernels behind planes, against NumPy."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import ndimage

from recon.kernels.planes import PLANES
from recon.seeds import volume
from recon.seeds.planes import swept
from recon.seeds.stereo import FLAT, UNSEEN, Plate
from recon.seeds.volume import Volume

HEIGHT, WIDTH, FOCAL, CENTRE = 18, 37, 30.0, (17.5, 9.5)
ON_A_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
DICE = np.random.default_rng(5)


def plate(x: float = 0.0, z: float = 0.0, turn: float = 0.0) -> Plate:
    grey = ndimage.gaussian_filter(DICE.uniform(-400, 400, (HEIGHT, WIDTH)), 1.0)
    cam_from_world = np.array([[np.cos(turn), 0, np.sin(turn), x], [0, 1, 0, 0.1 * x], [-np.sin(turn), 0, np.cos(turn), z], [0, 0, 0, 1]])
    at, inside = torch.zeros(HEIGHT, WIDTH, 2), np.ones((HEIGHT, WIDTH), bool)
    return Plate(torch.from_numpy(grey).float(), (FOCAL, FOCAL), CENTRE, cam_from_world, at, inside)


def correlation(own: np.ndarray, there: np.ndarray, window: int) -> np.ndarray:
    means = [ndimage.uniform_filter(m, window, mode="nearest") for m in (own, there, own * own, there * there, own * there)]
    own_mean, mean, own_square, square, product = means
    spread = np.sqrt((own_square - own_mean**2 + FLAT**2) * (square - mean**2 + FLAT**2))
    return (product - own_mean * mean) / spread


def compared(own: Plate, others: list[Plate], inverse_depth: np.ndarray, window: int) -> np.ndarray:
    """What one plane costs."""
    costs = []
    rays = own.rays().double().numpy()
    for other in others:
        motion = other.cam_from_world @ np.linalg.inv(own.cam_from_world)
        x, y, z = (rays @ motion[:3, :3].T + inverse_depth[..., None] * motion[:3, 3]).transpose(2, 0, 1)
        u, v = (FOCAL * axis / np.maximum(z, 1e-3) + c for axis, c in ((x, CENTRE[0]), (y, CENTRE[1])))
        there = ndimage.map_coordinates(other.grey.double().numpy(), [v - 0.5, u - 0.5], order=1, mode="grid-constant")
        inside = (u > 0) & (u < WIDTH) & (v > 0) & (v < HEIGHT) & (z > 0.1 * inverse_depth)
        costs.append(np.where(inside, 1 - correlation(own.grey.double().numpy(), there, window), UNSEEN))
    return np.sort(costs, 0)[: 1 if len(others) < 3 else 2].mean(0)


@pytest.mark.parametrize(("window", "many"), [(5, 2), (7, 3)])
@pytest.mark.parametrize("stretch", [1024, 8])
def test_planes_are_compared_as_numpy_compares_them(window, many, stretch, monkeypatch):
    own, others = plate(), [plate(0.6), plate(-0.5, 0.2, 0.1), plate(0.3, -1.5, -0.3)][:many]
    step = torch.from_numpy(DICE.uniform(0.8, 1.2, (1, WIDTH)) * np.linspace(0.01, 0.02, HEIGHT)[:, None]).float()
    bounds = torch.from_numpy(np.sort(DICE.uniform(-10, 110, (2, HEIGHT, WIDTH)), 0)).float()
    bounds[:, :4, 30:] = torch.nan
    known = torch.where(torch.rand(HEIGHT, WIDTH, generator=torch.Generator().manual_seed(2)) < 0.1, 0.5, torch.nan)
    costs = Volume(own, others)
    monkeypatch.setitem(volume.STRETCH, "cpu", stretch)
    costs._compare(step, bounds, known, window)
    for n in range(PLANES):
        matters = ~bounds[0].isnan().numpy()
        outside = ((n < bounds[0]) | (n > bounds[1])).numpy()
        expected = compared(own, others, n * step.double().numpy(), window) + volume.OUTSIDE * outside
        expected += volume.PINNED * np.nan_to_num(np.minimum(np.abs(n - (known / step).numpy()) / 2, 1))
        got = costs.cost[..., n].numpy()
        within = matters & ~outside
        np.testing.assert_allclose(got[within], expected[within], atol=2e-3)
        assert (got[matters & outside] >= volume.OUTSIDE).all()


def test_costs_are_summed_along_four_paths_as_numpy_sums_them():
    own = plate()
    costs = Volume(own, [plate(0.5)])
    cost = DICE.uniform(0, 1, (HEIGHT, WIDTH, PLANES))
    costs.cost.copy_(torch.from_numpy(cost))
    grey = own.grey.double().numpy()
    expected = np.zeros_like(cost)
    for down, right in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        paths = np.zeros_like(cost)
        for y in range(HEIGHT)[:: down or 1]:
            for x in range(WIDTH)[:: right or 1]:
                paths[y, x] = cost[y, x]
                if 0 <= y - down < HEIGHT and 0 <= x - right < WIDTH:
                    before = paths[y - down, x - right]
                    jump = volume.JUMP / (1 + abs(grey[y, x] - grey[y - down, x - right]) / volume.EDGE)
                    beside = np.pad(before, 1, constant_values=np.inf)
                    ways = [before, beside[:-2] + volume.NUDGE, beside[2:] + volume.NUDGE, np.full(PLANES, before.min() + jump)]
                    paths[y, x] += np.min(ways, 0) - before.min()
        expected += paths
    for _ in range(2):  # the second time over what the first has left
        costs._smooth()
        np.testing.assert_allclose(costs.total.numpy(), expected, atol=1e-4)


def test_depths_are_the_same_bits_each_time():
    own, others = plate(), [plate(0.6), plate(-0.5)]
    step, bounds = torch.full((HEIGHT, WIDTH), 0.01), torch.tensor([3.0, 90.0])[:, None, None].repeat(1, HEIGHT, WIDTH)
    known, lowest = torch.full((2, HEIGHT, WIDTH), torch.nan)[0], torch.full((HEIGHT, WIDTH), 0.5)
    ways = [Volume(own, others).best(step, bounds, known, lowest, 5) for _ in range(2)]
    for first, second in zip(*ways, strict=True):
        assert torch.equal(first.nan_to_num(-1), second.nan_to_num(-1))


@ON_A_GPU
def test_a_gpu_finds_the_depths_that_the_cpu_finds():
    pictures = [plate(), plate(0.6), plate(-0.5)]
    there = [replace(p, grey=p.grey.cuda()) for p in pictures]
    deepest, points = np.full((HEIGHT, WIDTH), np.inf), np.zeros((0, 3))
    found, on_gpu = (swept(p[0], p[1:], 2.0, points, deepest) for p in (pictures, there))
    assert (np.isfinite(found) == np.isfinite(on_gpu)).mean() > 0.98
    assert np.nanquantile(np.abs(on_gpu / found - 1), 0.98) < 1e-3  # two planes may cost the same but for rounding
