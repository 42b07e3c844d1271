"""Cut-out objects lose what is not theirs and nothing else."""

from dataclasses import replace

import pytest
import torch
from street import box, splats

from recon.assets.cleaning import cleaned, lies_on_road, of_object, outliers
from recon.assets.extract import shown_colours
from recon.assets.sight import Views, sight_of
from scenes import Gaussians, Trajectory
from scenes.poses import translation, yaw
from scenes.seen import SECTORS

SIZE = torch.tensor([4.2, 1.8, 1.5], dtype=torch.float64)
CAR = box((4.2, 1.8, 1.5), (0.8, 0.1, 0.1), step=0.15)
CAR = CAR.select(CAR.means[:, 2] > 0.06)


def at(part: Gaussians, x: float, y: float, z: float = 0.0) -> Gaussians:
    return replace(part, means=part.means + torch.tensor([x, y, z]))


def kept(extra: Gaussians, clean=cleaned) -> tuple[int, int]:
    """How many of the car's and of the other splats cleaning leaves."""
    both = Gaussians.cat([CAR, extra])
    mine = both.means[:, None].isclose(CAR.means[None]).all(2).any(1) if len(both) < 3000 else None
    left = clean(both, SIZE)
    same = left.means[:, None].isclose(CAR.means[None]).all(2).any(1)
    assert mine is not None
    return int(same.sum()), int((~same).sum())


def test_a_clean_car_stays_whole():
    assert len(cleaned(CAR, SIZE)) > 0.99 * len(CAR)


def test_floaters_go():
    dice = torch.Generator().manual_seed(0)
    places = (torch.rand(12, 3, generator=dice) - 0.5) * torch.tensor([8.0, 6.0, 1.0]) + torch.tensor([0, 0, 3.5])
    dust = splats(places, (0.5,) * 3, (0.1,) * 3)
    mine, others = kept(dust)
    assert mine > 0.99 * len(CAR) and others == 0
    assert outliers(Gaussians.cat([CAR, dust]))[-12:].sum() >= 8


def test_road_under_the_car_goes_and_its_sills_stay():
    x, y = torch.meshgrid(torch.arange(-2.0, 2.0, 0.2), torch.arange(-0.9, 0.9, 0.2), indexing="ij")
    road = splats(torch.stack([x, y, torch.full_like(x, 0.08)], -1).reshape(-1, 3), (0.3,) * 3, (0.15, 0.15, 0.01))
    assert lies_on_road(road).all() and not lies_on_road(CAR).any()
    assert kept(road) == (len(CAR), 0)
    assert not lies_on_road(at(road, 0, 0, 0.5)).any()


def test_a_neighbours_bumper_within_the_box_goes_and_a_mirror_stays():
    bumper = at(box((0.2, 1.2, 0.3), (0.1, 0.1, 0.8), step=0.1), 2.5, 0.0, 0.4)
    assert kept(bumper)[1] == 0
    together = Gaussians.cat([CAR, at(box((0.2, 0.2, 0.2), (0.1, 0.8, 0.1), step=0.1), 0.6, 1.0, 0.8)])
    assert of_object(together, SIZE).all()  # it hangs on the door


def test_nothing_is_cleaned_to_nothing():
    assert len(cleaned(Gaussians.empty(), SIZE)) == 0


def test_a_car_seen_from_behind_and_its_left_says_so(street):
    path = Trajectory(street.ego.times_us[:1], (translation(9.0, -3.0) @ yaw(0.0))[None])
    sectors = sight_of(Views(street), path, SIZE).sectors
    assert list(sectors) == list(SECTORS) and sectors["rear left"] > 0
    assert sectors["rear"] + sectors["rear left"] + sectors["left"] == sum(
        sectors.values()
    )  # close by, its rear is past the picture's edge
    turned = Trajectory(street.ego.times_us[:1], (translation(9.0, -3.0) @ yaw(torch.pi))[None])
    there = sight_of(Views(street), turned, SIZE).sectors
    assert [there[name] for name in ("front", "front right", "right")] == [sectors[name] for name in ("rear", "rear left", "left")]


def test_exposure_statistics_are_linear_light():
    told = shown_colours(splats(torch.zeros(50, 3), (0.5, 0.735, 1.0), (0.1,) * 3))
    assert told["linear_mean"] == pytest.approx([0.214, 0.5, 1.0], abs=2e-3) == told["linear_p95"]
    assert shown_colours(Gaussians.empty()) == {}
