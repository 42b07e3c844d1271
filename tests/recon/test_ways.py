"""What ways cost by kernels is what they cost written down plainly, for one depth, one of each way, and one of each pixel."""

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from scipy import ndimage

from recon.seeds.stereo import UNSEEN, WINDOW, Plate, moments_of
from recon.seeds.ways import unlike

SIZE = 40, 56


def plate(seed: int, move: tuple[float, ...] = (0.0, 0.0, 0.0), turn: float = 0.0) -> Plate:
    chance = np.random.default_rng(seed)
    cam_from_world = np.eye(4)
    cam_from_world[[0, 0, 2, 2], [0, 2, 0, 2]] = np.cos(turn), np.sin(turn), -np.sin(turn), np.cos(turn)
    cam_from_world[:3, 3] = move
    grey = torch.from_numpy(ndimage.gaussian_filter(chance.normal(0, 90, SIZE), 1.2)).float()
    return Plate(grey, (50.0, 52.0), (28.5, 19.0), cam_from_world, torch.zeros(*SIZE, 2), np.ones(SIZE))


def sides(ways: np.ndarray) -> list:
    before = [(plate(1, (0.2, 0.0, 0.5)), -ways), (plate(2, (0.0, 0.1, 1.0), 0.05), -2 * ways)]
    return [before, [(plate(3, (-0.3, 0.0, -0.5)), ways)]]


def plainly(own: Plate, others, rows: slice, depth: torch.Tensor) -> torch.Tensor:
    """The like of `unlike`, picture by picture; depth `[N, h, w]`."""
    grey = own.grey[None, rows]
    points = own.rays().double()[rows] * depth[:, rows, :, None].double()
    world = (points - torch.from_numpy(own.cam_from_world[:3, 3])) @ torch.from_numpy(own.cam_from_world[:3, :3])
    of_sides = []
    for side in others:
        costs, counts = torch.zeros(points.shape[:3]), torch.zeros(points.shape[:3])
        for other, ways in side:
            turn, shift = torch.from_numpy(other.cam_from_world[:3, :3]), torch.from_numpy(other.cam_from_world[:3, 3])
            local = (world + torch.from_numpy(ways)[:, None, None]) @ turn.T + shift
            at = local[..., :2] / local[..., 2:].clamp_min(1e-3) * torch.tensor(other.focal) + torch.tensor(other.centre)
            grid = 2 * at / torch.tensor([SIZE[1], SIZE[0]]) - 1
            shown = F.grid_sample(other.grey.expand(len(grid), 1, -1, -1), grid.clamp(-3, 3).float(), align_corners=False)[:, 0]
            (mean, spread), (theirs, their_spread) = moments_of(grey), moments_of(shown)
            products = F.avg_pool2d(F.pad(shown * grey, [WINDOW // 2] * 4, mode="replicate"), WINDOW, 1)
            seen = (grid.abs().amax(-1) < 1) & (local[..., 2] > 0.5)
            costs += torch.where(seen, 1 - (products - mean * theirs) / (spread * their_spread), 0.0)
            counts += seen
        of_sides.append(torch.where(counts > 0, costs / counts.clamp_min(1), UNSEEN))
    return torch.stack(of_sides).amin(0)


@pytest.mark.parametrize("count", [1, 16, 19])
@pytest.mark.parametrize("kind", ["one", "of each way", "of each pixel"])
def test_ways_cost_what_they_cost_written_down_plainly(count, kind):
    chance = np.random.default_rng(count)
    ways, own, rows = chance.normal(0, 0.6, (count, 3)), plate(0), slice(7, 33)
    every = torch.full((count, *SIZE), 6.0)
    given: float | np.ndarray | torch.Tensor = 6.0
    if kind == "of each way":
        given = np.linspace(3.0, 30.0, count)
        every = torch.from_numpy(given)[:, None, None].expand(count, *SIZE)
    if kind == "of each pixel":
        given = torch.from_numpy(chance.uniform(3.0, 30.0, SIZE)).float()
        every = given.expand(count, *SIZE)
    told, true = unlike(own, sides(ways), rows, given), plainly(own, sides(ways), rows, every)
    assert told.shape == (count, 26, SIZE[1]) and true.std() > 0.1
    off = (told - true).abs()
    on_the_rim = 2 * SIZE[1] / told[0].numel()  # which pixels of it are in view, rounding says
    assert off.median() < 1e-5 and (off > 1e-3).float().mean() < on_the_rim / 10


def test_some_columns_cost_what_they_do_in_the_whole():
    ways, own = np.random.default_rng(4).normal(0, 0.3, (5, 3)), plate(0)
    whole, part = unlike(own, sides(ways), slice(None), 8.0), unlike(own.columns(slice(10, 40)), sides(ways), slice(None), 8.0)
    assert torch.allclose(part[..., WINDOW:-WINDOW], whole[..., 10 + WINDOW : 40 - WINDOW], atol=1e-4)


def test_what_no_other_shows_costs_as_much_as_nobody_knows():
    away = np.array([[0.0, 0.0, -20.0], [500.0, 0.0, 0.0]])  # behind them, and far aside
    assert (unlike(plate(0), sides(away), slice(None), 6.0)[1] == UNSEEN).all()
    behind = [[(plate(1), away)], [(plate(2), away)]]
    assert (unlike(plate(0), behind, slice(None), 6.0) == UNSEEN).all()


def test_the_same_picture_where_it_went_is_alike():
    own = plate(0)
    same = [[(plate(0), np.array([[0.0, 0.0, 0.0], [0.4, 0.0, 0.0]]))]]
    still, gone = unlike(own, same, slice(None), 5.0)
    assert still.median() < 0.05 and gone.median() > 0.3
