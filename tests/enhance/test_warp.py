"""Moving images by flow."""

import torch

from enhance.past import Past
from enhance.warp import shrink_flow, visible, warp


def constant_flow(x, y, h=10, w=14):
    return torch.tensor([x, y], dtype=torch.float32)[None, :, None, None].repeat(1, 1, h, w)


def test_whole_pixel_flow_moves_exactly():
    previous = torch.rand(1, 2, 10, 14)
    moved, inside = warp(previous, constant_flow(3, -1))
    assert torch.allclose(moved[..., 1:, :-3], previous[..., :-1, 3:], atol=1e-6)
    assert inside[..., 0, :].sum() == 0 and inside[..., -3:].sum() == 0 and inside[..., 1:, :-3].min() == 1


def test_zero_flow_changes_nothing():
    previous = torch.rand(2, 3, 9, 7)
    moved, inside = warp(previous, torch.zeros(2, 2, 9, 7))
    assert torch.allclose(moved, previous, atol=1e-6) and inside.min() == 1


def test_unknown_flow_spreads_nothing():
    flow = constant_flow(0, 0)
    flow[..., 4, 5] = torch.nan
    moved, inside = warp(torch.ones(1, 1, 10, 14), flow)
    assert torch.isfinite(moved).all() and inside[0, 0, 4, 5] == 0 and moved[0, 0, 4, 5] == 0 and inside.sum() == 139


def test_shrunk_flow_is_the_mean_in_blocks():
    flow = constant_flow(8, 16, 16, 16)
    flow[..., 0, 0] = torch.nan
    flow[..., 8:, 8:] = torch.inf
    small = shrink_flow(flow, (2, 2))
    assert torch.allclose(small[0, :, 0, 0], torch.tensor([1.0, 2.0])) and torch.isnan(small[0, :, 1, 1]).all()


def test_points_that_return_are_visible_and_others_are_not():
    there, back = constant_flow(2, 0), constant_flow(-2, 0)
    seen = visible(there, back)[0, 0]
    assert seen[:, :-2].all() and not seen[:, -2:].any()
    assert not visible(there, constant_flow(3, 0)).any()
    back[..., 5, 5] = torch.nan
    assert not visible(there, back)[0, 0, 5, 3]


def a_past(h=24, w=24):
    grid = torch.rand(1, 13, h // 8, w // 8)
    return Past(torch.rand(1, 2, 16, h // 8, w // 8), torch.ones(1, 2, 1, h // 8, w // 8), torch.rand(1, 3, h, w),
                torch.ones(1, 1, h, w), grid, torch.full_like(grid[:, :1], 2))  # fmt: skip


def test_all_of_the_past_moves_by_whole_cells_and_what_left_the_image_is_forgotten():
    past = a_past()
    moved = past.moved(constant_flow(8, 0, 24, 24))
    for name in ("latents", "fields"):
        assert torch.allclose(getattr(moved, name)[..., :-1], getattr(past, name)[..., 1:], atol=1e-5), name
    assert torch.allclose(moved.rgb[..., :-8], past.rgb[..., 8:], atol=1e-5)
    for kept in (moved.valid, moved.count / 2):
        assert kept[..., :-1].min() == 1 and kept[..., -1].max() == 0
    assert moved.seen[..., :-8].min() == 1 and moved.seen[..., -8:].max() == 0


def test_unknown_flow_forgets_the_past_there():
    moved = a_past().moved(torch.full((1, 2, 24, 24), torch.nan))
    assert moved.valid.max() == 0 and moved.seen.max() == 0 and moved.count.max() == 0
    assert all(torch.isfinite(value).all() for value in vars(moved).values())
