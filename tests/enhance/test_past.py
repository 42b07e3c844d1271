"""The past moved to the next frame."""

import pytest
import torch

from enhance.alike import thin
from enhance.flow import shrink_flow
from enhance.network.past import Past


def constant_flow(x, y, h=10, w=14):
    return torch.tensor([x, y], dtype=torch.float32)[None, :, None, None].repeat(1, 1, h, w)


def test_shrunk_flow_is_the_mean_in_blocks():
    flow = constant_flow(8, 16, 16, 16)
    flow[..., 0, 0] = torch.nan
    flow[..., 8:, 8:] = torch.inf
    small = shrink_flow(flow, (2, 2))
    assert torch.allclose(small[0, :, 0, 0], torch.tensor([1.0, 2.0])) and torch.isnan(small[0, :, 1, 1]).all()
    assert shrink_flow(constant_flow(8, 16, 16, 32), (2, 2))[0, :, 0, 0].tolist() == [0.5, 2.0], "in cells, which are wider than high"


def a_past(h=24, w=24):
    return Past(torch.rand(1, 2, 16, h // 8, w // 8), torch.ones(1, 2, 1, h // 8, w // 8), torch.rand(1, 3, h, w),
                torch.ones(1, 1, h, w))  # fmt: skip


def test_all_of_the_past_moves_by_whole_cells_and_what_left_the_image_is_forgotten():
    past = a_past()
    moved = past.moved(constant_flow(8, 0, 24, 24))
    assert torch.allclose(moved.latents[..., :-1], past.latents[..., 1:], atol=1e-5)
    assert torch.allclose(moved.rgb[..., :-8], past.rgb[..., 8:], atol=1e-5)
    assert moved.valid[..., :-1].min() == 1 and moved.valid[..., -1].max() == 0
    assert moved.seen[..., :-8].min() == 1 and moved.seen[..., -8:].max() == 0


def test_what_was_forgotten_stays_so_where_it_moves_to():
    past = a_past()
    past.valid[..., 1], past.seen[..., 8:16] = 0, 0
    moved = past.moved(constant_flow(8, 0, 24, 24))
    assert moved.valid[..., 0].max() == 0 and moved.valid[..., 1].min() == 1
    assert moved.seen[..., :8].max() == 0 and moved.seen[..., 8:16].min() == 1


def test_the_newest_is_remembered_first_and_the_oldest_forgotten():
    past, new = a_past(), torch.full((1, 16, 3, 3), 7.0)
    known = torch.zeros(1, 1, 3, 3)
    after = past.followed(torch.rand(1, 3, 24, 24), new, 2, known)
    assert torch.equal(after.latents, torch.stack([new, past.latents[:, 0]], 1)) and torch.equal(after.valid[:, 0], known)


def test_unknown_flow_forgets_the_past_there():
    moved = a_past().moved(torch.full((1, 2, 24, 24), torch.nan))
    assert moved.valid.max() == 0 and moved.seen.max() == 0
    assert all(torch.isfinite(value).all() for value in vars(moved).values())


@pytest.mark.parametrize(
    ("size", "small"),
    [((360, 640), (90, 160)), ((540, 960), (90, 160)), ((1920, 1080), (160, 90)), ((16, 16), (16, 16)), ((17, 33), (16, 32))],
)
def test_thinning_keeps_proportions_and_whole_pixels(size, small):
    image = torch.rand(1, 3, *size)
    found = thin(image)
    assert found.shape[-2:] == small
    assert torch.isin(found[0, 0], image[0, 0]).all()
    assert torch.equal(found[..., 0, 0], image[..., 0, 0]) and torch.equal(found[..., -1, -1], image[..., -1, -1])
