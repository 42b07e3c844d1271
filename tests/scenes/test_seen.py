"""Which cameras see an actor, and from where nobody ever saw it."""

from dataclasses import replace

import pytest
import torch
from street import car

from scenes.insert import insert
from scenes.placement import Placement
from scenes.seen import SECTORS, sector, seeing, unseen_sides, unseen_warning


def recorded(street):
    return [street.camera("front_camera", int(t)) for t in street.frame_times("front_camera")]


def known(asset, mirrored=False, **sectors):
    counts = dict.fromkeys(SECTORS, 0) | {name.replace("_", " "): n for name, n in sectors.items()}
    return replace(asset, meta={**asset.meta, "id": "car/0007", "sectors": counts, "mirrored": mirrored})


@pytest.mark.parametrize(("x", "y", "seen"), [(12, 3, True), (3, 0, True), (-8, 0, False), (3, 12, False)])
def test_it_is_known_whether_an_actor_is_ever_in_view(street, x, y, seen):
    actor = insert(street, car(), Placement("car", x, y)).actor
    assert bool(seeing(actor, recorded(street))) == seen


def test_sectors_go_round_to_the_left_from_the_nose():
    points = [(torch.cos(a).item(), torch.sin(a).item()) for a in torch.arange(8) * torch.pi / 4 + 0.3]
    assert [sector(*p) for p in points] == list(SECTORS)


def test_a_side_counts_as_seen_where_photos_were_taken_of_it_or_well_from_beside():
    assert unseen_sides(car()) == [], "what does not say has all sides"
    assert unseen_sides(known(car(), **dict.fromkeys(map(str, SECTORS), 1))) == []
    rear = known(car(), rear=30, rear_left=9, left=2)
    assert unseen_sides(rear) == ["front", "front left", "right", "front right"], "two from the left are too few for what is beside it"
    assert unseen_sides(known(car(), mirrored=True, rear=30, rear_left=9, left=2)) == ["front", "front left", "front right"]
    assert unseen_sides(known(car(), mirrored=True, rear=30, rear_left=9, left=6)) == ["front"]
    assert unseen_sides(known(car(), mirrored=True, rear=30, left=6, front_left=5)) == []


def test_who_shows_an_unseen_side_is_told(street):
    asset = known(car(), mirrored=True, rear=30, rear_left=9, left=6)
    ahead = insert(street, asset, Placement("car/0007", 12, 0)).actor
    assert unseen_warning(ahead, seeing(ahead, recorded(street))) == [], "it shows its rear"
    oncoming = insert(street, asset, Placement("car/0007", 12, 0, yaw=torch.pi)).actor
    (said,) = unseen_warning(oncoming, seeing(oncoming, recorded(street)))
    assert said.startswith("car/0007 is shown from its front, from where no photo") and "assets show car/0007" in said
    assert unseen_warning(oncoming, []) == []
    assert unseen_warning(insert(street, car(), Placement("car", 12, 0, yaw=torch.pi)).actor, recorded(street)) == []
