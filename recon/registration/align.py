"""Corrects the path of a drive whose lidar sweeps do not agree by its recorded poses.

Heights by GPS drift by decimetres within seconds (KITTI), or are not recorded at all (nuScenes), cheaper receivers and odometry shake from
pose to pose, and splats made from such sweeps lie in layers. Every sweep is registered point to plane (Chen and Medioni 1992) to others
that saw the same surfaces, and all poses are optimised together in a pose graph, with the recorded motion as a prior: what sweeps do not
determine, as the way along a bare road, stays as recorded.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from recon.log import Log, Sweep
from recon.registration.corrected import MOVED, as_corrected
from scenes.poses import small_poses

APART = (1, 3, 9, 27)
"""Numbers of sweeps between those that are registered to each other."""

FARTHEST = 60.0
"""Metres: a sweep keeps no points from farther away."""

TOGETHER_US = 25_000
"""Sweeps that begin within this time are one: a car's lidars turn together."""

SAMPLES = 1500
"""Points of a sweep that are registered to another one."""

FEWEST = 50
"""Of these, those that must meet a surface of it."""

REACH = (1.0, 0.7, 0.5, 0.3, 0.3)
"""Metres up to which a plane is searched for, round by round."""

ALIKE = 20.0
"""Neighbouring points have the same errors: so many count as one."""

STEP = (3e-4, 3e-4, 3e-4, 0.01, 0.01, 0.01)
"""Standard deviations, in radians and metres, of the difference between the corrections of consecutive sweeps."""

SHAKES, LOOSE = 2.0, 2.0
"""Times as much as `STEP` by which corrections jump from sweep to sweep where a path shakes, and times as much as they jump that they may
differ by then."""

WHOLE = (0.05, 0.05, 0.05, 2.0, 2.0, 2.0)
"""Standard deviations of a correction itself."""

NORMAL = 0.6745
"""The median size of what is normally distributed, in standard deviations."""

PROBE = 4
"""Every how many sweeps one is tried, to see whether anything has to be corrected."""

WORTH, UNKNOWN = 0.03, 0.001
"""Metres by which corrections of sweeps that are registered to each other must differ for corrections to be made; the second where the log
records no heights: a car goes up and down on its springs by centimetres, and pictures of the road then do not tell how cameras are mounted.
"""


@dataclass(frozen=True)
class Grain:
    """How finely surfaces are told: one point is kept in each `cell` of so many metres, and at `kept` of these, spread evenly, a plane is
    fitted to so many `neighbours`. It is at most as thick as a part `flat` of its smaller extent, and goes through that point, or `amid`
    them all: points of one sweep are as thick as its lidar's noise, those of many as these are apart."""

    cell: float
    kept: int
    neighbours: int
    flat: float
    amid: bool = False


STREET = Grain(cell=0.25, kept=8000, neighbours=12, flat=0.1)

NARROW = 0.1
"""Part of a plane's larger extent that the smaller one must be, or its points lie on one of the lidar's rings and could span anything."""


@dataclass(frozen=True)
class Surfaces:
    """Points `[N, 3]` of a sweep where a surface is flat, its normals there, and where the body stood, in the world as recorded."""

    points: np.ndarray
    normals: np.ndarray
    centre: np.ndarray
    tree: cKDTree

    @staticmethod
    def of(xyz: np.ndarray, centre: np.ndarray, grain: Grain = STREET) -> Surfaces:
        near = xyz[np.linalg.norm(xyz - centre, axis=1) < FARTHEST]
        thin = near[thinned(near - centre, grain.cell)]
        if len(thin) < grain.neighbours:
            return Surfaces(thin[:0], thin[:0], centre, cKDTree(np.zeros((1, 3))))
        some = thin[:: max(1, len(thin) // grain.kept)]
        around = thin[cKDTree(thin).query(some, grain.neighbours)[1]]
        middles = around.mean(1)
        around -= middles[:, None]
        values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", around, around))
        extent = np.sqrt(values.clip(0))
        flat = (extent[:, 0] < grain.flat * extent[:, 1]) & (extent[:, 1] > NARROW * extent[:, 2])
        kept = (middles if grain.amid else some)[flat]
        return Surfaces(kept, vectors[flat, :, 0], centre, cKDTree(kept if len(kept) else np.zeros((1, 3))))


def thinned(points: np.ndarray, cell: float) -> np.ndarray:
    """Indices of one of the points `[N, 3]` in each cell of so many metres."""
    cells = np.floor(points / cell).astype(np.int64) @ np.array([1, 1 << 20, 1 << 40])
    return np.unique(cells, return_index=True)[1]


def aligned(log: Log, sweeps: Sequence[Sweep], report: Callable[[], None] = lambda: None) -> Log:
    """The log with its body's path, cameras, sweeps and boxes moved to where `sweeps` meet one another; as it is where they do already.

    `report` is called for each sweep. Corrections are interpolated between sweeps and go on beyond the first and the last.
    """
    kept: dict[int, Surfaces] = {}

    def surfaces(some: Sequence[list[Sweep]]) -> list[Surfaces]:
        for turn in some:
            if turn[0].index not in kept:
                xyz = np.concatenate([sweep.read().xyz for sweep in turn])
                kept[turn[0].index] = Surfaces.of(xyz, log.ego.near(turn[0].time_us)[:3, 3].numpy())
                report()
        return [kept[turn[0].index] for turn in some]

    turns = _turns(sweeps)
    worth = WORTH if log.meta.get("heights", True) else UNKNOWN
    if len(turns) < 2 * PROBE or _unlike(_corrections(surfaces(turns[::PROBE]), PROBE), PROBE) < worth:
        return log
    found = _corrections(surfaces(turns))
    print(f"{log.path}: its sweeps lie up to {_unlike(found):.2f} m apart by its recorded poses, which are corrected", file=sys.stderr)
    poses = about(np.stack([cloud.centre for cloud in surfaces(turns)]), found)
    path = {"times_us": [turn[0].time_us for turn in turns], "poses": poses.flatten(1).tolist()}
    return as_corrected(log, {MOVED: path})


def about(centres: np.ndarray, deltas: np.ndarray) -> torch.Tensor:
    """Poses `[K, 4, 4]` of small motions `[K, 6]` about points `[K, 3]`."""
    poses, centre = small_poses(torch.from_numpy(deltas)), torch.from_numpy(centres)
    poses[:, :3, 3] += centre - (poses[:, :3, :3] @ centre[:, :, None])[..., 0]
    return poses


def _turns(sweeps: Sequence[Sweep]) -> list[list[Sweep]]:
    """The sweeps by time, those of several lidars that turn together in one."""
    turns: list[list[Sweep]] = []
    for sweep in sorted(sweeps, key=lambda s: s.time_us):
        if turns and sweep.time_us - turns[-1][0].time_us < TOGETHER_US:
            turns[-1].append(sweep)
        else:
            turns.append([sweep])
    return turns


def _apart(count: int, step: int) -> list[int]:
    """`APART` of `count` sweeps, of which only every `step`th is at hand."""
    return [k for k in sorted({max(1, round(k / step)) for k in APART}) if k < count]


def _unlike(deltas: np.ndarray, step: int = 1) -> float:
    """Metres by which the corrections of sweeps that are laid on one another differ at most."""
    return max(float(np.linalg.norm(deltas[k:, 3:] - deltas[:-k, 3:], axis=1).max()) for k in _apart(len(deltas), step))


def _corrections(clouds: list[Surfaces], step: int = 1) -> np.ndarray:
    """Small motions `[K, 6]` in the world, each about its own centre, with which the clouds meet; of every `step`th sweep."""
    count = len(clouds)
    deltas = np.zeros((count, 6))
    pairs = [(i, i + k) for k in _apart(count, step) for i in range(count - k)]
    pairs += [(j, i) for i, j in pairs]
    centres = np.stack([c.centre for c in clouds])
    for reach in REACH:
        poses = about(centres, deltas).numpy()
        blocks = [met(clouds[i].points, centres[i], clouds[j], poses[i], poses[j], reach, FEWEST) for i, j in pairs]
        deltas = _solved(deltas, pairs, blocks, step)
    turn, away = deltas[:, :3].mean(0), centres - centres.mean(0)  # sweeps do not tell how they lie as a whole: as they did in the mean
    deltas[:, 3:] -= np.cross(turn, away)
    return deltas - deltas.mean(0)


def met(
    points: np.ndarray, centre: np.ndarray, other: Surfaces, pose: np.ndarray, other_pose: np.ndarray, reach: float, fewest: int
) -> tuple[np.ndarray, np.ndarray]:
    """Normal equations `[12, 12]`, `[12]` of laying some of the points `[N, 3]` of one cloud, which stood at `centre`, on the surfaces of
    another within `reach` metres, for further small motions of both; zeros where fewer than so many points meet them."""
    points = points[:: max(1, len(points) // SAMPLES)]
    here = points @ pose[:3, :3].T + pose[:3, 3]
    there = (here - other_pose[:3, 3]) @ other_pose[:3, :3]
    away, nearest = other.tree.query(there, distance_upper_bound=reach)
    meets = np.isfinite(away) & (nearest < len(other.points))
    if meets.sum() < fewest:
        return np.zeros((12, 12)), np.zeros(12)
    here, nearest = here[meets], nearest[meets]
    surface = other.points[nearest] @ other_pose[:3, :3].T + other_pose[:3, 3]
    normal = other.normals[nearest] @ other_pose[:3, :3].T
    off = ((here - surface) * normal).sum(1)
    jacobian = np.concatenate([np.cross(here - centre, normal), normal, -np.cross(surface - other.centre, normal), -normal], 1)
    spread = max(0.02, 1.5 * float(np.median(np.abs(off))))
    weight = 1 / (1 + (off / spread) ** 2) / (ALIKE * spread**2)
    return (jacobian * weight[:, None]).T @ jacobian, -(jacobian * weight[:, None]).T @ off


def _differ(deltas: np.ndarray, step: int) -> np.ndarray:
    """By how much corrections of consecutive sweeps may differ, `[6]` standard deviations: a path drifts by little (`STEP`), but each of
    its poses may be off by itself. Corrections found so far tell that by how far each is off the middle of those beside it, as none is
    where a path drifts, or sweeps are laid on what moves."""
    usual = np.sqrt(step) * np.array(STEP)
    if len(deltas) < 3:
        return usual
    jumps = np.abs(np.diff(deltas, 2, axis=0)) / np.sqrt(2)
    for level in ([0, 1], [2], [3, 4], [5]):  # neither of the world's level axes is the car's
        jump = np.median(jumps[:, level]) / NORMAL
        if jump > SHAKES * usual[level[0]]:
            usual[level] = LOOSE * jump
    return usual


def _solved(deltas: np.ndarray, pairs: list[tuple[int, int]], blocks: list[tuple[np.ndarray, np.ndarray]], step: int) -> np.ndarray:
    """The corrections after one step of Gauss and Newton."""
    count = len(deltas)
    own, steady = 1 / np.array(WHOLE) ** 2, 1 / _differ(deltas, step) ** 2
    rows: list[np.ndarray] = []
    columns: list[np.ndarray] = []
    values: list[np.ndarray] = []
    right = -own * deltas
    change = steady * np.diff(deltas, axis=0)
    right[:-1] += change
    right[1:] -= change

    def add(i: int, j: int, block: np.ndarray) -> None:
        row, column = np.meshgrid(6 * i + np.arange(6), 6 * j + np.arange(6), indexing="ij")
        for numbers, more in ((rows, row), (columns, column), (values, block)):
            numbers.append(more.ravel())

    for i in range(count):
        add(i, i, np.diag(own))
    for i in range(count - 1):
        for a, b, sign in ((i, i, 1), (i + 1, i + 1, 1), (i, i + 1, -1), (i + 1, i, -1)):
            add(a, b, sign * np.diag(steady))
    for (i, j), (normal, wanted) in zip(pairs, blocks, strict=True):
        for a, x in ((i, 0), (j, 6)):
            right[a] += wanted[x : x + 6]
            for b, y in ((i, 0), (j, 6)):
                add(a, b, normal[x : x + 6, y : y + 6])
    shape = (6 * count, 6 * count)
    matrix = coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape).tocsc()
    return deltas + spsolve(matrix, right.ravel()).reshape(count, 6)
