"""What pictures show to lie along the street lies along it in space."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from recon.fit.densify import LONGEST
from recon.fit.lines import StreetLines
from recon.fit.model import Splats, draw
from scenes.camera import Camera
from scenes.gaussians import Gaussians
from scenes.lenses import Pinhole
from scenes.poses import CAM_FROM_FLU, inverse, matrix_from_quat, quat_from_matrix, translation, yaw
from scenes.trajectory import Trajectory

LENS, SIZE = Pinhole(480.0, 480.0, 240.0, 135.0), (480, 270)
STILL = torch.eye(4, dtype=torch.float64)


def straight(metres=30.0, count=31, shakes=0.0):
    aside = np.random.default_rng(1).uniform(-shakes, shakes, count)
    poses = [translation(x, y, 1.5) for x, y in zip(np.linspace(0, metres, count), aside, strict=True)]
    return Trajectory(100_000 * torch.arange(count), torch.stack(poses))


def bend():
    """A quarter of a circle of 15 metres."""
    return Trajectory(
        100_000 * torch.arange(30),
        torch.stack([translation(15 * math.sin(a), 15 - 15 * math.cos(a), 1.5) @ yaw(a) for a in np.linspace(0, math.pi / 2, 30)]),
    )


def never(points):
    return np.zeros(len(points), bool)


def lines(path, struck=never, seen_through=never):
    return StreetLines(path, cameras(path), SimpleNamespace(struck=struck, seen_through=seen_through))


def cameras(path, aside=0.0):
    mount = translation(0, aside, 0) @ inverse(CAM_FROM_FLU)
    return [Camera(LENS, *SIZE, pose @ mount) for pose in path.world_from_body[::5]]


def square_to(eye, places, along, extents=(0.3, 0.02, 0.01)):
    """Splats at places `[N, 3]` that are square to the view from an eye `[3]` and look as if they lay along `[3]`."""
    rays = torch.nn.functional.normalize(places - eye, dim=1)
    across = torch.nn.functional.normalize(torch.linalg.cross(rays, along.expand_as(rays)), dim=1)
    axes = torch.stack([torch.linalg.cross(across, rays), across, -rays], 2)
    axes[:, :, 2] *= torch.linalg.det(axes)[:, None]
    n = len(places)
    scales = torch.tensor(extents).log().expand(n, 3).clone()
    g = Gaussians(places.float(), quat_from_matrix(axes).float(), scales, torch.full((n,), 3.0), torch.full((n, 1, 3), -1.7))
    return Splats.of([g], [torch.ones(n)])


def wire(seed=0, deep=0.2):
    """Splats that look like a wire along the street, 6 m to the left and 5 m above the eyes of a straight drive, at distances of their own;
    and the eye that they are square to."""
    rng = np.random.default_rng(seed)
    eye = torch.tensor([25.0, 0, 1.5], dtype=torch.float64)
    places = torch.stack([torch.tensor([x, 6.0, 6.5], dtype=torch.float64) for x in np.linspace(38, 50, 60)])
    places = eye + torch.from_numpy(rng.uniform(1 - deep, 1 + deep, (60, 1))) * (places - eye)
    return square_to(eye, places, torch.tensor([1.0, 0, 0], dtype=torch.float64)), eye


def seen_askew(splats, camera):
    """How far off their common line, in pixels, splats look from a camera, and how far they are turned off that, in degrees."""
    means = splats.fields["means"].double()
    tips = matrix_from_quat(splats.fields["quats"].double())[torch.arange(len(splats)), :, splats.fields["log_scales"].argmax(1)]
    back = inverse(camera.world_from_cam)

    def pixels(points):
        return camera.lens.project(points @ back[:3, :3].T + back[:3, 3])

    at, ahead = pixels(means), pixels(means + 0.05 * tips)
    middle = at - at.mean(0)
    _, _, axes = torch.linalg.svd(middle)
    turned = torch.nn.functional.normalize(ahead - at, dim=1) @ axes[0]
    return float((middle @ axes[1]).std()), float(torch.rad2deg(turned.abs().clamp_max(1).arccos()).median())


def picture(splats, camera):
    return draw(splats.placed({}), camera, "rgb", "alpha")[1]


@pytest.mark.parametrize("shakes", [0.0, 0.1])
def test_a_wire_along_the_street_is_one_line_from_beside_it(shakes):
    path, (splats, _) = straight(60.0, 61, shakes), wire()
    beside = cameras(path, aside=2.5)[4]
    off, turned = seen_askew(splats, beside)
    assert off > 3 and turned > 3
    for _ in range(8):
        assert lines(path).straighten(splats) == 60
    off, turned = seen_askew(splats, beside)
    assert off < 0.5 + 10 * shakes and turned < 0.5 + 10 * shakes
    thin, middle, long = splats.fields["log_scales"].exp().sort(1).values.unbind(1)
    assert thin.max() < 0.03 and (long < 0.7 * LONGEST * middle).all(), "as wide as it looks, and free to grow"


@pytest.mark.parametrize("rise", [0.0, 0.12])
def test_along_a_steep_street_wires_climb_and_cornices_are_level(rise):
    """Turned up to the street, a cornice would be a saw."""
    path = straight(60.0, 61)
    path.world_from_body[:, 2, 3] += rise * path.world_from_body[:, 0, 3]
    eye = torch.tensor([25.0, 0, 1.5 + 25 * rise], dtype=torch.float64)
    for climbs in (0.0, rise):
        along = torch.nn.functional.normalize(torch.tensor([1.0, 0, climbs], dtype=torch.float64), dim=0)
        places = torch.stack(
            [torch.tensor([x, 6.0, 6.5 + 25 * rise + climbs * (x - 38)], dtype=torch.float64) for x in np.linspace(38, 48, 40)]
        )
        splats = square_to(eye, places, along)
        assert lines(path).straighten(splats) == 40
        tips = matrix_from_quat(splats.fields["quats"].double())[torch.arange(40), :, splats.fields["log_scales"].argmax(1)]
        assert float(torch.rad2deg((tips @ along).abs().clamp_max(1).arccos()).max()) < 0.5


def test_the_pictures_of_the_path_stay():
    path, (splats, eye) = straight(), wire(deep=0.0)
    nearest = next(c for c in cameras(path) if torch.allclose(c.world_from_cam[:3, 3], eye))
    before = picture(splats, nearest)
    lines(path).straighten(splats)
    assert before.max() > 0.5 and (picture(splats, nearest) - before).abs().mean() < 0.06 * before.mean()
    on_path, beside = cameras(path)[3], cameras(path, aside=2.5)[3]
    assert seen_askew(splats, on_path)[1] < 0.5 and seen_askew(splats, beside)[1] < 0.5


def test_what_does_not_look_along_the_street_stays():
    eye, place = torch.tensor([25.0, 0, 1.5], dtype=torch.float64), torch.tensor([[40.0, 6.0, 6.5]], dtype=torch.float64)
    along = torch.tensor([1.0, 0, 0], dtype=torch.float64)
    look = straight()
    for other in (
        square_to(eye, place, torch.tensor([0.0, 0, 1], dtype=torch.float64)),  # a pole
        square_to(eye, place, torch.tensor([0.0, 1, 0], dtype=torch.float64)),  # a wire across the street
        square_to(eye, place, along, (0.3, 0.2, 0.01)),  # hardly longer than wide
        square_to(eye, place, along, (0.01, 0.001, 0.001)),  # too short to look like anything
        square_to(eye, place - torch.tensor([0, 0, 6.0]), along),  # on the road
        square_to(eye, torch.tensor([[40.0, 0.05, 2.2]], dtype=torch.float64), along),  # where the street vanishes: lengths do not show
        square_to(eye, torch.tensor([[-5.0, 6.0, 6.5]], dtype=torch.float64), along),  # in no picture
    ):
        before = {name: field.clone() for name, field in other.fields.items()}
        assert lines(look).straighten(other) == 0
        assert all(torch.equal(field, before[name]) for name, field in other.fields.items())


def test_actors_and_what_is_faint_stay():
    splats, _ = wire()
    of_actor = Splats(splats.fields, [0, len(splats)], splats.reach)
    path = straight()
    assert lines(path).straighten(of_actor) == 0
    splats.fields["logits"][:] = -4.0
    assert lines(path).straighten(splats) == 0


@pytest.mark.parametrize("path", [bend(), straight(0.0)])
def test_who_turns_or_stands_says_nothing_of_lines(path):
    eye = path.world_from_body[-1, :3, 3]
    ahead = path.world_from_body[-1, :3, 0]
    place = eye + 15 * ahead + torch.tensor([0, 0, 5.0])
    splats = square_to(eye, place[None] + 3 * path.world_from_body[-1, :3, 1], ahead)
    assert lines(path).straighten(splats) == 0


@pytest.mark.parametrize("move", ["above", "farther on"])
def test_edges_beside_one_another_stay_two(move):
    """Though they are as far away up to a fifth, which is less than what one of them may vary by."""
    path, eye, along = straight(), torch.tensor([25.0, 0, 1.5], dtype=torch.float64), torch.tensor([1.0, 0, 0], dtype=torch.float64)
    x = torch.linspace(36, 40, 20, dtype=torch.float64)
    one = torch.stack([x, torch.full_like(x, 6.0), torch.full_like(x, 6.5)], 1)
    other = one + torch.tensor([0, 0, 1.0 if move == "above" else 0.0])
    other = eye + 1.2 * (other - eye) + (torch.tensor([12.0, 0, 0]) if move == "farther on" else 0.0)
    both = square_to(eye, torch.cat([one, other]), along)
    before = both.fields["means"].clone()
    for _ in range(4):
        assert lines(path).straighten(both) == 40
    torch.testing.assert_close(both.fields["means"], before, rtol=0, atol=0.05)


def test_two_wires_one_behind_the_other_stay_two():
    path = straight()
    near, _ = wire(deep=0.0)
    far, _ = wire(deep=0.0)
    eye = torch.tensor([25.0, 0, 1.5])
    far.fields["means"] = eye + 2.0 * (far.fields["means"] - eye)
    both = Splats({k: torch.cat([near.fields[k], far.fields[k]]) for k in near.fields}, [120], torch.ones(120))
    for _ in range(4):
        lines(path).straighten(both)
    away = (both.fields["means"][:, 1:] - torch.tensor([0, 1.5])).norm(dim=1)
    torch.testing.assert_close(away[:60], torch.full((60,), math.hypot(6, 5)), rtol=0.02, atol=0)
    assert (away[60:] > 1.8 * math.hypot(6, 5)).all()


def test_nothing_goes_where_lidar_looked_through():
    path, (splats, eye) = straight(), wire()
    first = (splats.fields["means"] - eye).norm(dim=1)
    lines(path, seen_through=lambda points: np.linalg.norm(points - eye.numpy(), axis=1) < first.numpy() - 1e-3).straighten(splats)
    after = (splats.fields["means"] - eye).norm(dim=1)
    assert (after > first - 0.01).all() and (after > first + 0.1).any()


def test_what_lidar_saw_stays_where_it_is_and_draws_the_others():
    path, (splats, eye), (true, _) = straight(), wire(), wire(deep=0.0)
    held, means = torch.arange(60) % 3 == 0, splats.fields["means"]
    means[held] = true.fields["means"][held]
    means[~held] = (eye + 1.2 * (true.fields["means"][~held] - eye)).float()
    for _ in range(8):
        lines(path, lambda points: held.numpy()).straighten(splats)
    assert torch.equal(means[held], true.fields["means"][held])
    away = (means[~held][:, 1:] - torch.tensor([0, 1.5])).norm(dim=1)
    torch.testing.assert_close(away, torch.full((40,), math.hypot(6, 5)), rtol=0.01, atol=0)
