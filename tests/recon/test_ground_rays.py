import numpy as np
import pytest
import torch

from recon.seeds.dense import ground_depth
from recon.seeds.ground_rays import ground_hits
from recon.seeds.stereo import Plate
from scenes.ground import Ground

EYE = np.array([0.0, 0.0, 1.5])
FALLS = np.array([-0.5, -0.2, -0.12, -0.1, -0.06, -0.03, -0.01, 0.02, 0.06, 0.15])
RAYS = np.stack([np.ones(len(FALLS)), np.zeros(len(FALLS)), FALLS], 1)


def street(height) -> Ground:
    """A street along x, 100 m to each side of the eye and level beyond."""
    return Ground(height(torch.arange(-100.0, 101.0)).float().expand(2, 201).contiguous(), (-100.0, -1.0), 1.0)


@pytest.mark.parametrize("below", [0.0, 0.3])
@pytest.mark.parametrize("rise", [-0.08, -0.04, 0.0, 0.04, 0.08, 0.2])
def test_on_a_slope_rays_go_as_far_as_the_slope_says_up_and_down(rise, below):
    hits = ground_hits(EYE, RAYS, street(lambda x: rise * x), below)
    there = (1.5 + below) / (rise - FALLS)
    on_slope = (there > 0) & (there < 100)
    assert on_slope.sum() >= 3
    np.testing.assert_allclose(hits[on_slope], there[on_slope], rtol=1e-6)
    assert (hits[~on_slope] > 99).all(), "what falls no faster than the street goes on over its end"


def test_pictures_take_a_street_that_falls_to_be_as_far_as_it_is():
    plate = Plate(torch.zeros(60, 80), (60.0, 60.0), (40.0, 30.0), np.eye(4), torch.zeros(60, 80, 2), np.ones((60, 80), bool))
    plate.cam_from_world[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]
    plate.cam_from_world[:3, 3] = -plate.cam_from_world[:3, :3] @ EYE
    depth = ground_depth(plate, street(lambda x: -0.08 * x), 0.0)
    fall = plate.rays()[..., 1].numpy()
    before_end = fall > 0.08 + 1.5 / 95
    np.testing.assert_allclose(depth[before_end], 1.5 / (fall[before_end] - 0.08), rtol=1e-5)
    assert np.isinf(depth[fall < 0]).all()


def test_over_a_crest_and_waves_rays_meet_the_ground_where_they_first_come_to_it():
    def waves(x: torch.Tensor) -> torch.Tensor:
        return -0.1 * (x - 30).clamp_min(0) + 0.05 * torch.sin(x / 3)

    ground = street(waves)
    hits = ground_hits(EYE, RAYS, ground)
    fine = np.arange(0.5, 99, 0.01)
    for ray, hit in zip(RAYS, hits, strict=True):
        at = EYE + fine[:, None] * ray
        under = at[:, 2] < ground.height(torch.from_numpy(at[:, :2])).numpy()
        first = fine[under.argmax()] if under.any() else np.inf
        assert abs(hit - first) < 0.02 if under.any() else hit > 99


def test_a_ground_above_the_eye_is_met_by_no_ray():
    assert np.isinf(ground_hits(EYE, RAYS, street(lambda x: 0 * x + 2))).all()
    assert np.isinf(ground_hits(EYE, -RAYS[FALLS < 0], street(lambda x: 0 * x))).all()
    assert ground_hits(EYE, np.zeros((0, 4, 3)), street(lambda x: 0 * x)).shape == (0, 4)
