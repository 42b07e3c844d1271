"""The past moved to the next frame."""

import torch

from enhance.flow import shrink_flow
from enhance.past import Past


def constant_flow(x, y, h=10, w=14):
    return torch.tensor([x, y], dtype=torch.float32)[None, :, None, None].repeat(1, 1, h, w)


def test_shrunk_flow_is_the_mean_in_blocks():
    flow = constant_flow(8, 16, 16, 16)
    flow[..., 0, 0] = torch.nan
    flow[..., 8:, 8:] = torch.inf
    small = shrink_flow(flow, (2, 2))
    assert torch.allclose(small[0, :, 0, 0], torch.tensor([1.0, 2.0])) and torch.isnan(small[0, :, 1, 1]).all()


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
