"""Seeds where lidar has none: how far away everything in the pictures is, kept where pictures agree on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from recon.ground import above_ground, cells_of
from recon.log import Log, SparsePoints, Track
from recon.seeds.ground_rays import ground_hits
from recon.seeds.measured import PICTURES, Measured, by_pictures
from recon.seeds.planes import swept
from recon.seeds.points import Cloud, nearest_box
from recon.seeds.road import Road
from recon.seeds.stereo import Plate, plate_of
from recon.seeds.sunken import known_ground
from recon.side_by_side import side_by_side
from recon.views.frames import Frames
from recon.views.project import project
from recon.views.view import View
from render.progress import Progress
from scenes.camera import Camera
from scenes.ground import Ground
from scenes.poses import inverse
from scenes.spread import spread

VIEWS, BETWEEN = (40, 150), 0.15
"""Pictures a camera whose depth is found: from so many, where there are, up to so many, to stand no farther apart on a long way than this
part of the distance to what they show; on a longer one in groups."""

OTHERS = 40
"""Pictures, the nearest, that are asked whether they find the same."""

BASELINES, ALLOWED = (0.06, 0.2), 2.5
"""Distances to the pictures that one is compared with, before and after it, in distances to what it shows; and how many times more or less
is allowed."""

LEAST = BASELINES[0] / ALLOWED
"""Distance to another picture, in distances to what one shows, from which on they show it from two places: of a car that waits, shaking by
a millimetre, they look alike at any depth."""

NEARER = 0.6
"""Part of the distance to the nearest points from which on depths are tried: between the points there may be something nearer."""

TURNED = 0.8
"""Cosine between the directions of two pictures that are compared, at least."""

AGREE, AGREEING = 0.05, 2
"""Part of its depth by which a place may differ between pictures, and in how many others it must be found."""

FARTHEST = 1000.0
"""Metres: farther is taken to be there."""

DUG, BURIED = 0.3, 0.1
"""Metres under the ground where things may still be found, since it is not known better; where more than this part of a picture's points
are under that, it is not known at all but where points lie on it (`known_ground`)."""


@dataclass(frozen=True)
class Depths:
    """A picture, its camera at the picture's size, its plate, and the depth z `[h, w]` of its pixels, NaN where it is not known."""

    view: View
    camera: Camera
    plate: Plate
    depth: np.ndarray

    def only(self, mask: np.ndarray) -> Depths:
        """The depths of a mask `[h, w]` alone."""
        return replace(self, depth=np.where(mask, self.depth, np.nan))

    def on(self, road: Road) -> Depths:
        """The depths with what may be the road on it, and without what is under it."""
        off, slack = road.off(self.points())
        met = ground_depth(self.plate, road.ground, 0.0)
        met[np.isinf(met)] = np.nan
        known = road.off(replace(self, depth=met).points())[1] > 0  # a ray that hardly falls may meet it far beyond
        depth = np.where((np.abs(off) < slack) & known, met, self.depth)
        return replace(self, depth=np.where((off < -slack) & (slack > 0), np.nan, depth))

    def points(self) -> np.ndarray:
        """What its pixels show, `[h, w, 3]` in the world."""
        return self.plate.points(self.depth)

    def cells(self, size: Sequence[int]) -> tuple[np.ndarray, np.ndarray]:
        """Row and column `[h, w]` of what its pixels show on a grid of a size (rows, columns) over the picture."""
        x, y = np.nan_to_num(self.plate.at.numpy()).transpose(2, 0, 1)
        row, column = y * (size[0] / self.camera.height), x * (size[1] / self.camera.width)
        return row.clip(0, size[0] - 1).astype(np.int64), column.clip(0, size[1] - 1).astype(np.int64)

    def cloud(self, gains: np.ndarray) -> Cloud:
        """What is known of it, with the picture's colours; gains: the cameras' exposures `[C, 3]`."""
        known = np.isfinite(self.depth)
        row, column = (index[known] for index in self.cells((self.camera.height, self.camera.width)))
        return Cloud(self.points()[known], self.view.evenly(row, column) / gains[self.view.camera])


def cloud_from_pictures(
    log: Log, frames: Frames, sparse: SparsePoints, found: Sequence[Depths], movers: list[Track], gains: np.ndarray
) -> tuple[Cloud, Measured]:
    """Points `[N, 3]` with colours where training pictures agree how far it is, as was `found` (`agreeing`), and these depths.

    gains: the cameras' exposures `[C, 3]`. Sky stays empty, and what the boxes of `movers` may hide. ValueError where no picture shows a
    point.
    """
    found = [own.only(_clear(own, movers)) for own in found]
    cloud = Cloud.cat([own.cloud(gains) for own in found])
    if len(cloud.xyz) < len(sparse.xyz):
        cloud = Cloud.cat([cloud, *_points_themselves(log, frames, sparse, movers, gains)])
    if not len(cloud.xyz):
        raise ValueError(f"{log.path}: no training picture shows what another one shows; match more pictures, or take other cameras")
    return cloud, measured_by(found, PICTURES)


def measured_by(found: Sequence[Depths], weight: float) -> Measured:
    """Their depths, to be held to."""
    return Measured({(own.view.camera, own.view.index): by_pictures(own.plate, own.depth, own.camera) for own in found}, weight)


def believed(log: Log, frames: Frames, sparse: SparsePoints, ground: Ground, movers: list[Track]) -> list[Depths]:
    """Depths on which pictures agree, NaN in all other pixels, in the sky, and where the boxes of `movers` may hide what is there."""
    return [own.only(_clear(own, movers)) for own in agreeing(log, frames, sparse, ground)]


def agreeing(log: Log, frames: Frames, sparse: SparsePoints, ground: Ground) -> list[Depths]:
    """Depths on which pictures agree, NaN in all other pixels."""
    found = depths(log, frames, sparse, ground)
    return [own.only(mask) for own, mask in zip(found, agreed(found), strict=True)]


def points_of(found: Sequence[Depths]) -> np.ndarray:
    """All that is known of them, `[N, 3]` in the world."""
    return np.concatenate([np.zeros((0, 3)), *(own.points()[np.isfinite(own.depth)] for own in found)])


def _points_themselves(log: Log, frames: Frames, sparse: SparsePoints, movers: list[Track], gains: np.ndarray) -> list[Cloud]:
    """The sparse points as the training pictures show them, for pictures that stand too far apart to be compared."""
    made = []
    for view in frames.training():
        name = frames.names[view.camera]
        camera = frames.camera(log, view)
        points = sparse.xyz[sparse.seen[name][view.index]]
        row, column, depth, inside = project(points, inverse(camera.world_from_cam).numpy(), camera)
        inside &= (depth < nearest_box(camera, movers)[row, column]) & view.shows_street(row, column)
        made.append(Cloud(points[inside], view.evenly(row[inside], column[inside]) / gains[view.camera]))
    return made


def depths(log: Log, frames: Frames, sparse: SparsePoints, ground: Ground) -> list[Depths]:
    """Of training pictures spread over the drive (`VIEWS`), those that show points of `sparse` and resemble others."""
    found = []
    known = known_ground(sparse.xyz, ground, log.ego) & log.meta.get("metric", True)
    for c, name in enumerate(frames.names):
        views = frames.of(c)
        cameras = [frames.camera(log, v) for v in views]
        plates = [plate_of(v.image, camera) for v, camera in zip(views, cameras, strict=True)]
        points = [sparse.xyz[sparse.seen[name][v.index]] for v in views]
        chosen = _chosen(plates, points)
        with Progress(f"depths of {name}", total=len(chosen)) as steps:
            work = partial(_depth_of, plates=plates, points=points, ground=ground, known=known)
            for i, depth in zip(chosen, side_by_side(work, chosen), strict=True):
                found += [Depths(views[i], cameras[i], plates[i], depth)] if depth is not None else []
                steps.step()
    return found


def _chosen(plates: list[Plate], points: list[np.ndarray]) -> list[int]:
    typical = [float(np.median(z)) for z in (_before(*pair) for pair in zip(plates, points, strict=True)) if len(z)]
    if not typical:
        return []
    far = float(np.median(typical))
    way = np.linalg.norm(np.diff([p.eye() for p in plates], axis=0), axis=1).sum()
    least, most = VIEWS
    wanted = int(way / (BETWEEN * far))
    if wanted <= most:
        return spread(range(len(plates)), max(wanted, least))
    # the way is too long for all to have neighbours that could agree: some, and those that they are compared with
    return sorted({j for i in spread(range(len(plates)), most // 5) for j in (i, *companions(i, plates, far))})


def _before(plate: Plate, points: np.ndarray) -> np.ndarray:
    """Depths z of those of the points that a plate has before it."""
    z = plate.shown(points)[2]
    return z[z > 0]


def _depth_of(i: int, plates: list[Plate], points: list[np.ndarray], ground: Ground, known: np.ndarray) -> np.ndarray | None:
    """Depth z of one of the plates; nothing where it shows none of its points or resembles no other. known: the cells of the ground that
    nothing is under, whatever points say."""
    shown = points[i]
    z = _before(plates[i], shown)
    others = companions(i, plates, float(np.median(z))) if len(z) else []
    if not others:
        return None
    deepest = ground_depth(plates[i], ground, DUG)
    if (above_ground(shown, ground) < -DUG).mean() > BURIED:
        met = plates[i].points(np.where(np.isfinite(deepest), deepest, 0.0))
        deepest = np.where(known[cells_of(met, ground)], deepest, np.inf)
    near = NEARER * max(float(np.quantile(z, 0.05)), 0.1 * float(np.median(z)))
    nearest = min(near, max(near / 3, 0.95 * float(deepest.min())))
    return np.minimum(swept(plates[i], [plates[j] for j in others], nearest, shown, deepest), FARTHEST)


def companions(i: int, plates: list[Plate], typical: float) -> list[int]:
    """Which pictures one is compared with: before and after it, at about `BASELINES` of the typical depth."""
    away = np.array([np.linalg.norm(p.eye() - plates[i].eye()) for p in plates]) / typical
    along = np.array([p.axis() @ plates[i].axis() for p in plates]) > TURNED
    found = []
    for side in (np.arange(len(plates)) < i, np.arange(len(plates)) > i):
        for part in BASELINES:
            ratio = np.abs(np.log(np.maximum(away, 1e-9) / part))
            ratio[~(side & along)] = np.inf
            if ratio.min(initial=np.inf) < np.log(ALLOWED):
                found.append(int(ratio.argmin()))
    apart = np.where(along & (away > LEAST), away, np.inf)
    # photos far apart have none at those: the nearest are better than none
    return list(dict.fromkeys(found)) or [int(j) for j in apart.argsort()[:2] if apart[j] < 1]


def ground_depth(plate: Plate, ground: Ground, below: float) -> np.ndarray:
    """Depth z `[h, w]` at which a plate's rays are so many metres under the ground; infinite above the horizon (`ground_hits`)."""
    back = np.linalg.inv(plate.cam_from_world)
    return ground_hits(back[:3, 3], plate.rays().double().numpy() @ back[:3, :3].T, ground, below)


def agreed(found: list[Depths]) -> list[np.ndarray]:
    """Masks `[h, w]` of what at least `AGREEING` other pictures find in the same place, and no more see through: the rest is guessed, or
    moves. Pictures from the same place, of a car that waits, make the same mistakes, and are not asked."""
    masks = []
    for own in found:
        points = own.points()
        agree, through = np.zeros((2, *own.depth.shape), np.int64)
        away = [float(np.linalg.norm(other.plate.eye() - own.plate.eye())) for other in found]
        least = LEAST * float(np.nanmedian(own.depth)) if np.isfinite(own.depth).any() else np.inf
        facing = [i for i, other in enumerate(found) if away[i] > least and other.plate.axis() @ own.plate.axis() > 0]
        for other in (found[i] for i in sorted(facing, key=away.__getitem__)[:OTHERS]):
            row, column, z, inside = other.plate.shown(points)
            there = other.depth[row, column]
            agree += inside & (np.abs(there - z) < AGREE * z)
            through += inside & (there > (1 + 2 * AGREE) * z)
        masks.append((agree >= min(AGREEING, max(1, len(facing)))) & (through <= agree) & own.plate.inside)
    return masks


def _clear(own: Depths, movers: list[Track]) -> np.ndarray:
    """Mask `[h, w]` of what is no sky, and before the boxes of `movers`."""
    row, column = own.cells((own.camera.height, own.camera.width))
    clear = own.view.shows_street(row, column)
    if not movers:
        return clear
    depth = own.camera.lens.depth(own.plate.rays().double() * torch.from_numpy(own.depth)[..., None]).numpy()
    return clear & (depth < nearest_box(own.camera, movers)[row, column])
