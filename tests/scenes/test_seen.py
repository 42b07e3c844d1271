"""Which cameras see an actor, and from where nobody ever saw it."""

from dataclasses import replace

import pytest
import torch
from street import car

from scenes import Equirectangular, Fisheye, OpenCV
from scenes.insert import insert
from scenes.placement import Placement
from scenes.seen import SECTORS, absence_warning, sector, seeing, unseen_sides, unseen_warning


def recorded(street):
    return [street.camera("front_camera", int(t)) for t in street.frame_times("front_camera")]


def known(asset, mirrored=False, **sectors):
    counts = dict.fromkeys(SECTORS, 0) | {name.replace("_", " "): n for name, n in sectors.items()}
    return replace(asset, meta={**asset.meta, "id": "car/0007", "sectors": counts, "mirrored": mirrored})


@pytest.mark.parametrize(("x", "y", "seen"), [(12, 3, True), (3, 0, True), (-8, 0, False), (3, 12, False)])
def test_it_is_known_whether_an_actor_is_ever_in_view(street, x, y, seen):
    actor = insert(street, car(), Placement("car", x, y)).actor
    assert bool(seeing(actor, recorded(street))) == seen


@pytest.mark.parametrize(
    ("lens", "place", "seen"),
    [
        (Equirectangular.whole(96, 54), (-10, 3), True),
        (Fisheye(30.0, 30.0, 48.0, 27.0), (-10, 3), False),  # its image ends 92 degrees from the axis, to the sides
        (Fisheye(25.0, 25.0, 48.0, 27.0), (-1, 8), True),
        (OpenCV(50.0, 50.0, 48.0, 27.0, -0.1), (2, 12), False),  # beyond 61 degrees it folds over
        (OpenCV(50.0, 50.0, 48.0, 27.0, -0.1), (12, 6), True),
    ],
)
def test_each_lens_sees_as_far_as_it_goes(street, lens, place, seen):
    actor = insert(street, car(), Placement("car", *place)).actor
    assert bool(seeing(actor, [replace(recorded(street)[0], lens=lens)])) == seen


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        ("0,12,0 1,14,0", None),
        ("0,12,0 0.3,12.5,0", "from 0s to 0.3s after the clip's first frame, and the clip lasts 0.7s: it appears or disappears in view"),
        ("0.4,12,0 2,14,0", "from 0.4s to 2s after the clip's first frame, and the clip lasts 0.7s: it appears or disappears in view"),
        ("0,5,0 0.3,5,30", None),  # it is out of view when it goes
        ("2,12,0 3,14,0", "none of its frames shows it"),
        ("0,-12,0 1,-14,0", "never in view: X is metres forward"),
    ],
)
def test_it_is_said_that_an_actor_comes_or_goes_before_ones_eyes(street, tmp_path, rows, said):
    file = tmp_path / "t.csv"
    file.write_text("\n".join(["time_s,x_m,y_m", *rows.split()]))
    cameras = recorded(street)
    actor = insert(street, car(), Placement("car", trajectory=file), cameras[0].time_us).actor
    told = absence_warning(actor, cameras, seeing(actor, cameras))
    assert told == [] if said is None else said in told[0]


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
    assert "turn it (its yaw by 180deg), or take another one" in said
    replaced = replace(oncoming, asset=replace(oncoming.asset, meta={**oncoming.asset.meta, "edited": True}))
    assert "a guess; take another one" in unseen_warning(replaced, seeing(replaced, recorded(street)))[0], "its path is another's"
    assert unseen_warning(oncoming, []) == []
    assert unseen_warning(insert(street, car(), Placement("car", 12, 0, yaw=torch.pi)).actor, recorded(street)) == []
