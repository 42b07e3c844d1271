"""Boxes that are of their sweep's stamp (recon/movers/stamped.py)."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from followed_car import COUNT, SEEN, STAMPS, boxed, drive, shaken, way

from recon.movers.stamped import as_drawn
from recon.objects.actors import split_points
from recon.ready import annotated

LATE_US = -70_000
"""When the lidar passes over the car: 0.56 m before it is where the stamp has it."""


def test_a_simulators_boxes_are_drawn_around_their_points():
    log = drive(boxed(STAMPS, way(STAMPS)), late_us=lambda k: {0: LATE_US})
    found = as_drawn(log, log.sweeps)
    inner = slice(1, -1)  # the path goes on but half a step before it begins
    torch.testing.assert_close(found.tracks[0].world_from_box[inner], way(STAMPS + LATE_US)[inner], atol=0.01, rtol=0)
    assert found.tracks[0].times_us is log.tracks[0].times_us
    assert as_drawn(found, log.sweeps) is found, "once"


def test_all_points_of_what_is_fast_are_its_own_then():
    """Its left ahead, its rear behind: of boxes that are taken for what annotators draw the latter would be road."""
    log = drive(boxed(STAMPS, way(STAMPS)), late_us=lambda k: {0: LATE_US})
    for of, lost in ((log, True), (annotated(log, log.sweeps), False)):
        split = split_points(of, log.sweeps, list(of.tracks))
        local, _ = split.actors["veh_1"]
        assert (len(local) < 0.8 * COUNT * 120) == lost
        rear = (SEEN[:, 0] < -2.1).mean()
        assert ((local[:, 0] < -2.0).mean() > 0.8 * rear) != lost


@pytest.mark.parametrize("few", [False, True], ids=["all", "every fifth"])
def test_boxes_around_their_points_are_as_they_were(few):
    kept = slice(None, None, 5 if few else 1)
    log = drive(boxed(STAMPS[kept].copy(), shaken(way(STAMPS + LATE_US), 0.1)[kept]), late_us=lambda k: {0: LATE_US})
    assert as_drawn(log, log.sweeps) is log


def test_where_the_lidar_passes_at_the_stamp_nothing_tells():
    log = drive(boxed(STAMPS, way(STAMPS)), late_us=lambda k: {0: 10_000})
    assert as_drawn(log, log.sweeps) is log
    assert as_drawn(log, ()) is log


def test_what_is_not_seen_is_as_late_as_usual():
    """A second car, in no sweep, and one that stands."""
    log = drive(boxed(STAMPS, way(STAMPS)), late_us=lambda k: {0: LATE_US})
    aside = way(STAMPS)
    aside[:, 1, 3] += 200
    unseen = replace(boxed(STAMPS, aside), name="veh_2")
    standing = replace(boxed(STAMPS, way(0 * STAMPS)), name="veh_3", moving=False)
    _, second, third = as_drawn(replace(log, tracks=(*log.tracks, unseen, standing)), log.sweeps).tracks
    moved = (second.world_from_box - aside)[1:-1, :3, 3].norm(dim=1)
    np.testing.assert_allclose(moved, -8 * LATE_US / 1e6, atol=0.02)
    assert third is standing
