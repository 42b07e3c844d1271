"""How well a reconstruction holds where the car never drove: depth against lidar that the fit never saw, holes, and flicker."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from recon.evaluation.report import EQUAL_DB
from recon.evaluation.road import photo_at, road_errors, road_points, shown_road, standing
from recon.log import Log, Sweep
from recon.objects.actors import split_points
from recon.views.frames import Frames
from recon.views.project import nearest_around, project
from recon.views.skies import always_hidden, cells, looks_of
from render import render_frame
from render.compare import decibels
from render.rays import world_directions
from render.warp import warp
from scenes.camera import Camera
from scenes.poses import inverse
from scenes.scene import Scene

SHIFTS = (0.0, 1.0, 2.0, 3.0)
"""Metres aside of the recorded path: to the left for one sweep, to the right for the next."""

SOLID = 0.9
"""Alpha below which a pixel under the horizon counts as a hole."""

CELL = 4
"""Pixels around a lidar point within which a nearer one may hide it."""

HIDING = 1.25
"""How many times nearer a point must be to hide its neighbours: less is a slope."""

NEARER = 0.5
"""Part of a lidar point's distance nearer than which what is drawn stands in the way of it: no error of a surface, but another thing."""

CALM_FRAMES = 10
"""Consecutive frames of which flicker is measured."""


def held_out_sweeps(log: Log, every: int) -> tuple[Sweep, ...]:
    """Sweeps kept from the fit: one in `every`, half a period off the held-out pictures; none where `every` is 0."""
    return tuple(s for s in log.sweeps if every > 0 and s.index % every == every // 2)


def shifts_within(metres: float) -> list[float]:
    """`SHIFTS`, or as much less as makes `metres` the last: indoors three metres aside is another room."""
    return [round(shift * min(1.0, metres / SHIFTS[-1]), 1) for shift in SHIFTS]


def off_path_table(
    scene: Scene, log: Log, sweeps: Sequence[Sweep], frames: Frames | None = None, shifts: Sequence[float] = SHIFTS
) -> list[dict]:
    """A row for each of `shifts` metres, to the left and to the right by turns, over all cameras of the scene.

    depth_error: median of |d - lidar| / lidar over static lidar points of `sweeps` that the moved camera sees past these and what moves, d
    being the expected depth; points: how many those are. in_the_way: share of these points before which something is drawn at less than
    half of their distance: walls and floaters where lidar looked through, of which a median says nothing. movers_error: as depth_error, of
    points in moving boxes, where these are at the picture's moment. holes: share of pixels below the horizon with alpha under 0.9;
    holes_above: the same above it, where from the recorded path no sky is ever seen (None where it is seen everywhere): between a tree and
    the house behind it, and through windows. road: PSNR of the road's colours, at those of its points that both see, against the photo of
    `frames` taken at that moment from the path (None without them): the one truth that there is of how it looks from beside it. flicker:
    mean absolute difference to the previous picture moved along exact flow, in 8-bit levels, over pixels visible in both; first camera.
    """
    movers = [t for t in log.tracks if t.moving]
    splits = [(s, split_points(log, [s], movers)) for s in sweeps]
    ways = [np.zeros((0, 3)) if scene.ground is None else road_points(split.static, scene.ground) for _, split in splits]
    hidden = always_hidden(looks_of(scene))
    rows = []
    for shift in shifts:
        errors, moving, road, holes = [], [], [], {"holes": np.zeros(2), "holes_above": np.zeros(2)}
        paths = [scene.ego.shifted(lateral=side) for side in (shift, -shift)]
        for k, (sweep, split) in enumerate(splits):
            for name in scene.rig:
                times = scene.frame_times(name)
                time = int(times[(times - sweep.time_us).abs().argmin()])
                camera = scene.camera(name, time, paths[k % 2])
                with torch.no_grad():
                    frame = render_frame(scene, camera, ("rgb", "alpha", "depth"))
                assert frame.rgb is not None and frame.alpha is not None and frame.depth is not None
                alpha, depth = frame.alpha.cpu(), frame.depth.cpu()
                directions = world_directions(camera)
                ground = directions[..., 2] < 0
                for which, solid in (("holes", ground), ("holes_above", ~ground & hidden[cells(directions, len(hidden))])):
                    holes[which] += [int((solid & (alpha < SOLID)).sum()), int(solid.sum())]
                points = np.concatenate([split.static, split.moved(sweep.index, time)])
                off = depth_errors(depth.numpy(), points, camera)
                errors.append(off[: len(split.static)])
                moving.append(off[len(split.static) :])
                if frames is not None and len(ways[k]):
                    assert scene.ground is not None
                    recorded, others = scene.camera(name, time), standing(points, scene.ground, log.tracks, time)
                    both = shown_road(ways[k], others, camera) & shown_road(ways[k], others, recorded)
                    view = photo_at(frames, name, time)
                    road.append(road_errors(frame.rgb.cpu(), camera, view, recorded, ways[k][both]))
        still, going = _finite(errors), _finite(moving)
        row = {"shift_m": shift, "depth_error": _median(still), "movers_error": _median(going), "points": len(still)}
        row["in_the_way"] = float((still < -NEARER).mean()) if len(still) else None
        wrong = np.concatenate([np.zeros(0), *road])
        row["road"] = min(decibels(float(wrong.mean())), EQUAL_DB) if len(wrong) else None
        row |= {which: float(open_ / solid) if solid else None for which, (open_, solid) in holes.items()}
        rows.append(row | {"flicker": flicker_along(scene, shift)})
    return rows


def depth_errors(depth: np.ndarray, points: np.ndarray, camera: Camera) -> np.ndarray:
    """Relative errors `[N]` of `depth` `[H, W]` at world points `[N, 3]`, below 0 where it is too near; NaN at those that `camera` does not
    see, 1 where nothing was drawn."""
    row, column, z, seen = project(points, inverse(camera.world_from_cam).numpy(), camera)
    seen &= z <= HIDING * nearest_around(points, camera, CELL)[row, column]
    drawn = depth[row, column]
    off = np.where(np.isfinite(drawn), (drawn - z) / np.where(seen, z, 1.0), 1.0)
    return np.where(seen, off, np.nan)


def _finite(parts: Sequence[np.ndarray]) -> np.ndarray:
    found = np.concatenate([np.zeros(0), *parts])
    return found[np.isfinite(found)]


def _median(errors: np.ndarray) -> float | None:
    """Of their sizes; None where there are none."""
    return float(np.median(np.abs(errors))) if len(errors) else None


def flicker_along(scene: Scene, shift: float) -> float:
    """Exact-flow warp error of the first camera's middle frames along the path shifted by `shift` metres to the left, in 8-bit levels."""
    name = next(iter(scene.rig))
    times = scene.frame_times(name).tolist()
    first = max(0, (len(times) - CALM_FRAMES) // 2)
    path = scene.ego.shifted(lateral=shift)
    cameras = [scene.camera(name, t, path) for t in times[first : first + CALM_FRAMES]]
    found, last = [], None
    for previous, camera in zip([None, *cameras], cameras, strict=False):
        outputs = ("rgb",) if previous is None else ("rgb", "flow_prev", "visible_prev")
        with torch.no_grad():
            frame = render_frame(scene, camera, outputs, previous)
        rgb = _planes(frame.rgb)
        if last is not None and frame.visible_prev is not None:
            moved, inside = warp(last, _planes(frame.flow_prev))
            both = frame.visible_prev[None, None] & (inside > 0)
            if both.any():
                found.append(255 * float(((rgb - moved).abs().mean(1, keepdim=True))[both].mean()))
        last = rgb
    return float(np.mean(found)) if found else 0.0


def _planes(image: torch.Tensor | None) -> torch.Tensor:
    assert image is not None
    return image.permute(2, 0, 1)[None]


def off_path_text(rows: Sequence[dict]) -> str:
    """The rows for people."""
    heads = ("lidar points", "depth error", "in the way", "movers'", "holes", "above", "road, dB", "flicker, levels")
    lines = [f"{'off the path':<14}" + "".join(f" {head:>15}" for head in heads)]
    for r in rows:
        parts = (
            "-" if r[k] is None else f"{100 * r[k]:.2f} %" for k in ("depth_error", "in_the_way", "movers_error", "holes", "holes_above")
        )
        where = f"{r['shift_m']:g} m aside" if r["shift_m"] else "as recorded"
        road = "-" if r["road"] is None else f"{r['road']:.2f}"
        lines.append(f"{where:<14}" + "".join(f" {part:>15}" for part in (r["points"], *parts, road, f"{r['flicker']:.2f}")))
    return "\n".join(lines)
