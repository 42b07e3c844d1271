"""Flow to the frames before and after, of scenes by lot: against where each pixel's point stands there, in float64."""

import random
from dataclasses import replace

import pytest
import torch

from render import rasterize, render_frame
from render.frame_types import Frame
from scenes import Camera, Equirectangular, Placed
from scenes.poses import inverse, translation
from tests import oracle_lens
from tests.render.test_lenses import LENSES, around
from tests.render.test_rasterize import two_instances
from tests.render.test_shutter import PINHOLE, driven, traffic, turned


def some_way(dice: random.Random, metres: float, degrees: float) -> torch.Tensor:
    return translation(*(dice.uniform(-metres, metres) for _ in range(3))) @ turned(dice.uniform(-degrees, degrees))


def camera_by_lot(dice: random.Random) -> Camera:
    lens = dice.choice([PINHOLE, *LENSES.values()])
    shutter = "rows" if isinstance(lens, Equirectangular) else dice.choice(["rows", "columns"])
    camera, aside = driven(lens, shutter, dice.uniform(0, 30), dice.uniform(-100, 100)), some_way(dice, 0.3, 8)
    start, end = camera.world_from_cam @ aside, camera.world_from_cam_end @ aside
    return replace(camera, world_from_cam=start, world_from_cam_end=dice.choice([None, end]))


def at_another_time(placed: list[Placed], dice: random.Random) -> list[Placed]:
    """Each instance moved by itself; one may be missing, and stays where it was."""
    there, missing = [], dice.choice([None, *placed])
    for p in (p for p in placed if p is not missing):
        way, end = some_way(dice, 0.4, 6), p.world_from_local_end
        there.append(replace(p, world_from_local=way @ p.world_from_local, world_from_local_end=None if end is None else way @ end))
    return there


def stands(frame: Frame, placed: list[Placed], there: list[Placed], other: Camera) -> torch.Tensor:
    """`[H, W, 2]`: the pixels of `other` at which the points of a frame's pixels are read out; nan where its lens does not see them."""
    camera, pixels, found = frame.camera, frame.camera.pixel_centres(), torch.full((*frame.instance.shape, 2), torch.nan).double()
    axis, extent = (0, camera.width) if camera.shutter == "columns" else (1, camera.height)
    later, still = {p.instance: p for p in there}, torch.eye(4, dtype=torch.float64)
    ways = [(p.instance, camera, p, other, later.get(p.instance, replace(p, world_from_local_end=None))) for p in placed]
    sky = Placed(placed[0].gaussians, still)
    for instance, here, now, away, then in [*ways, (-1, unmoved(camera), sky, unmoved(other), sky)]:
        mine = frame.instance == instance
        at = pixels[mine]
        sight = camera.lens.unproject(at)
        if instance >= 0:
            sight = camera.lens.origins(at) + sight * frame.depth[mine].double()[:, None]
        cam_from_local, other_from_local = (
            oracle_lens.pose_at((c.world_from_cam, c.world_from_cam_end), (p.world_from_local, p.world_from_local_end))
            for c, p in ((here, now), (away, then))
        )
        moving = away.world_from_cam_end is not None or then.world_from_local_end is not None
        local = oracle_lens.transformed(inverse(cam_from_local(at[:, axis] / extent)), sight)
        moment = oracle_lens.readout(other.lens, other, other_from_local, local, torch.zeros_like(local), moving)
        seen = oracle_lens.transformed(other_from_local(moment), local)
        found[mine] = torch.where(other.lens.valid(seen)[:, None], other.lens.project(seen), torch.nan)
    return found


def unmoved(camera: Camera) -> Camera:
    """It only turns, as for the sky."""
    start, end = (None if p is None else translation(*(-p[:3, 3]).tolist()) @ p for p in (camera.world_from_cam, camera.world_from_cam_end))
    return replace(camera, world_from_cam=start, world_from_cam_end=end)


def assert_leads_there(found: torch.Tensor, expected: torch.Tensor, other: Camera, which: str) -> None:
    """Wherever either falls into the picture, or beside it: farther off rays graze the camera's plane, or a moving lens's edge."""
    size = torch.tensor([other.width, other.height])
    off = found - expected
    if isinstance(other.lens, Equirectangular):
        off[..., 0] -= (off[..., 0] / other.lens.period()).round() * other.lens.period()
    near = sum(((p > -size) & (p < 2 * size)).all(-1) for p in (found, expected)) > 0
    assert near.float().mean() > 0.1 and off[near].abs().max() < 1e-4, f"{which}: off by {off[near].abs().max():.1e}"


@pytest.mark.parametrize("part", range(2))
def test_flow_of_scenes_by_lot_leads_to_where_points_stand(part):
    for seed in range(4 * part, 4 * part + 4):
        dice = random.Random(seed)
        make, camera = dice.choice([two_instances, around, traffic]), camera_by_lot(dice)
        placed = make(seed)
        flow_to = {way: (at_another_time(placed, dice), camera_by_lot(dice)) for way in ("prev", "next")}
        frame = rasterize(placed, camera, ("depth", "instance", "flow_prev", "flow_next"), flow_to=flow_to)
        for way, (there, other) in flow_to.items():
            which = f"scene {seed}: {make.__name__}, from {camera.lens.kind} to {other.lens.kind}, {way}"
            found = camera.pixel_centres() + getattr(frame, f"flow_{way}")
            assert_leads_there(found, stands(frame, placed, there, other), other, which)


def test_a_scenes_flow_leads_to_where_its_actors_are_in_the_frame_before(street):
    times = street.frame_times("front_camera")[5:7].tolist()
    previous, camera = (street.camera("front_camera", t) for t in times)
    frame = render_frame(street, camera, ("depth", "instance", "flow_prev"), previous)
    assert (frame.instance == 1).sum() > 20
    expected = stands(frame, *(street.placed(t) for t in reversed(times)), previous)
    assert_leads_there(camera.pixel_centres() + frame.flow_prev, expected, previous, "the street")
