"""The order in which splats are composited."""

import numpy as np
import pytest
import torch

from render.kernels.types import CULLED
from render.order import MANY, depth_order


@pytest.mark.parametrize("count", [0, 1, 1000, MANY, 3 * MANY])
@pytest.mark.parametrize("part", [0.0, 0.4, 1.0])
def test_records_go_by_depth_and_then_by_index_without_those_that_are_culled(count, part):
    rng = np.random.default_rng(count)
    depths = rng.choice(rng.uniform(0.1, 5000, max(1, count // 3)).astype(np.float32), count).view(np.int32)  # three at each
    depths[rng.random(count) < part] = int(CULLED)
    there = np.flatnonzero(depths != int(CULLED))
    expected = there[np.argsort(depths[there].view(np.float32), kind="stable")]
    for threads in (1, 2):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            order = depth_order(torch.from_numpy(depths.copy()))
        finally:
            torch.set_num_threads(before)
        assert order.dtype == torch.int32 and order.tolist() == expected.tolist()
