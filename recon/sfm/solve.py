"""Poses and a common lens for pictures that have neither: structure from motion (Schönberger and Frahm 2016), all on the CPU."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from recon.log import image_size
from recon.sfm.agreement import AGREED, agreement
from recon.sfm.colmap import extract_features, mapping_options, pycolmap, verification_options
from recon.sfm.together import together
from render.progress import Progress

EXHAUSTIVE = 40
"""Pictures up to which every pair is matched; of more, only pairs that were taken soon after each other."""

WIDEST = math.radians(118)
"""Largest angle of view along the longer side of a lens that has to be found. A street ahead also fits a lens that is wider than the one it
was taken with: nine small photos of `lund` came to 124 to 133 degrees in four runs of six, at one pixel of error; at their true 70 degrees
it is half a pixel."""

USUAL, MORE = math.radians(60), 1.25
"""Angle of view along the longer side that is assumed where pictures do not determine it, between those of phones, dash cameras and cars'
own cameras; and how many times as many pictures this lens must register as the estimated one to be preferred. On a straight road a model
begins with two or three pictures, one behind the other, which any lens fits; in a clip of a highway half of the pictures then no longer
fit the lens that was found."""

MOST_DISTORTION = 0.5
"""Largest magnitude of COLMAP's k of a SIMPLE_RADIAL lens: those of dash cameras are about -0.3."""

USUAL_ERROR, WITHIN = 4.0, 1 / 240
"""Pixels by which COLMAP lets matches be off the motion between two pictures, and the part of a picture's longer side that is allowed where
it is less: of a small picture, 4 pixels are so much that a motion passes as a turn, and all others are placed along with it."""

FEWEST_SEEN = 15
"""Points of a model that a small picture must show to be placed, of which there are few; COLMAP's 30 leave most pictures of 320x180 out."""

BEGUN_WITH = (4.0, 1.0), (2.0, 0.5)
"""Of the two pictures that a model begins with: degrees between the rays to their points at least, and how far off these may be, in parts
of what matches may. The second is tried where pictures are small, since what begins with a false pair places all pictures nevertheless;
COLMAP's 16 degrees are those of pictures taken around something."""

FEWEST_PLACED = 3
"""Pictures that must be registered at least."""


@dataclass(frozen=True)
class Found:
    """A model of COLMAP's, None for none, how many pictures it places, and how far what they show agrees with that (`agreement`); and which
    pictures share nothing with these."""

    model: Any = None
    placed: int = 0
    agreed: float = 0.0
    elsewhere: frozenset[str] = frozenset()

    @property
    def right(self) -> int:
        """How many pictures are placed rightly, by all that can be told: all of a model's, or none."""
        return self.placed if self.agreed >= AGREED else 0

    def is_enough(self, asked: int) -> bool:
        return MORE * self.right > asked

    def better_than(self, other: Found) -> bool:
        if self.right or other.right:
            return self.right >= max(MORE * other.right, FEWEST_PLACED)
        return self.placed * self.agreed > other.placed * other.agreed


def solve(pictures: Path, names: list[str], workspace: Path, ordered: bool, angle_of_view: float | None, source: str) -> Found:
    """Find the poses of the named files in the folder `pictures` and their common lens; writes `workspace`/sparse/0.

    ordered: whether `names` follow each other in time, as the frames of a video. angle_of_view: horizontal, in radians; where None the
    focal length is estimated, up to `WIDEST`, and where that registers too few pictures, `USUAL` is assumed and reported on stderr.
    source: where the pictures come from, for messages.

    SIFT features are matched between all pairs, or between pictures near each other in `names` where these are `ordered` or many, and
    incremental mapping registers the pictures; the largest of its models is kept. Where too few of the pictures of the largest place are in
    one that agrees with what they show, others are tried. ValueError where it has too few pictures.
    """
    colmap = pycolmap()
    database, models = workspace / "database.db", workspace / "models"
    width, height = image_size(pictures / names[0])
    within = min(USUAL_ERROR, WITHIN * max(width, height))
    with Progress("structure from motion") as steps:
        steps.step(note="features")
        reader = colmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        if angle_of_view is not None:
            reader.camera_params = f"{width / 2 / math.tan(angle_of_view / 2)},{width / 2},{height / 2},0"
        extract_features(colmap, database, pictures, names, reader, colmap.FeatureExtractionOptions())
        steps.step(note="matches")
        verification = verification_options(colmap)
        verification.ransac.max_error = within
        if ordered or len(names) > EXHAUSTIVE:
            _match_neighbours(colmap, database, names, verification)
        else:
            colmap.match_exhaustive(database, verification_options=verification, device=colmap.Device.cpu)
        steps.step(note="poses")
        options = _solving_options(colmap, angle_of_view, within)
        places = together(colmap, database)
        asked = len(places[0])  # no lens places what shares nothing with the rest

        def tell(placed: int) -> None:
            steps.step(0, note=f"poses: {placed} of {len(names)} pictures placed")

        def sought(best: Found) -> Found:
            """The best of what was found before and of what the options lead to."""
            for degrees, part in BEGUN_WITH if within < USUAL_ERROR else BEGUN_WITH[:1]:
                if not best.is_enough(asked):
                    options.mapper.init_min_tri_angle, options.mapper.init_max_error = degrees, part * within
                    model, placed = _largest(colmap, database, pictures, models, options, tell)
                    other = Found(model, placed, agreement(colmap, database, model, max(width, height)) if placed else 0.0)
                    best = other if other.better_than(best) else best
            return best

        best, said = sought(Found()), ""
        if not best.is_enough(asked):
            angle = f"{math.degrees(_fix_lens(colmap, database, options)):.0f}deg"
            steps.step(0, note=f"poses once more, with a lens of {angle}")
            held = sought(best)
            if held is not best:
                if angle_of_view is None:
                    which = f"a lens of {angle} places {held.placed} of {asked}, one that is found {best.right}"
                    fix = f"lengths along its way are right as far as {angle} are: give --angle-of-view where it is known"
                    said = f"{source}: its pictures do not tell how wide its camera sees: {which}; {fix}"
                best = replace(held, model=_with_distortion(colmap, held.model))
    if best.placed < max(FEWEST_PLACED, len(names) // 4):
        fix = "take them closer together, with more overlap and things that stand still, while the camera moves"
        raise ValueError(f"only {best.placed} of {len(names)} pictures of {source} could be placed; {fix}")
    if said:
        print(said, file=sys.stderr)
    (workspace / "sparse" / "0").mkdir(parents=True)
    best.model.write(workspace / "sparse" / "0")
    database.unlink()
    here = {image.name for image in best.model.images.values() if image.has_pose}
    return replace(best, elsewhere=frozenset().union(*(place for place in places if not place & here)))


def _match_neighbours(colmap, database: Path, names: list[str], verification) -> None:
    """Match the features of pictures that are near each other in the order of `names`."""

    def rename(called: dict[str, str]) -> None:
        with colmap.Database.open(database) as opened:
            for image in opened.read_all_images():
                image.name = called[image.name]
                opened.update_image(image)

    in_order = {name: f"{i:08d}" for i, name in enumerate(names)}  # COLMAP goes by the alphabet, where 10.jpg comes before 9.jpg
    rename(in_order)
    colmap.match_sequential(database, verification_options=verification, device=colmap.Device.cpu)
    rename({number: name for name, number in in_order.items()})


def _solving_options(colmap, angle_of_view: float | None, within: float):
    """Options of incremental mapping, with the focal length held where the angle of view is known; `within`: pixels by which matches may be
    off."""
    options = mapping_options(colmap)
    if within < USUAL_ERROR:
        options.mapper.abs_pose_min_num_inliers = FEWEST_SEEN
    # two pictures of a drive lie one behind the other, and the defaults do not begin a model with such a pair
    options.mapper.init_max_forward_motion = 1.0
    if angle_of_view is None:
        options.min_focal_length_ratio = 0.5 / math.tan(WIDEST / 2)
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = angle_of_view is None
    return options


def _largest(colmap, database: Path, pictures: Path, made: Path, options, tell: Callable[[int], None]) -> tuple[Any, int]:
    """The model with the most registered pictures, None for none, and how many it has; `tell` is called with that number as it grows.

    COLMAP asks for a lens's width when it registers a picture, and not once all are adjusted together: a model of one that is no lens is
    none. Rays of what is bent a thousandfold all but meet, and pictures agree with any poses by those."""
    made.mkdir()
    placed = 0

    def more(count: int) -> None:
        nonlocal placed
        placed = count
        tell(placed)

    models = colmap.incremental_mapping(
        database, pictures, made, options,
        initial_image_pair_callback=lambda: more(2), next_image_callback=lambda: more(placed + 1),
    )  # fmt: skip
    shutil.rmtree(made)
    likely = [m for m in models.values() if all(_is_lens(camera, options) for camera in m.cameras.values())]
    best = max(likely, key=lambda m: m.num_reg_images(), default=None)
    return best, 0 if best is None else best.num_reg_images()


def _is_lens(camera, options) -> bool:
    """Whether a camera sees no wider than the options let it, and moves the border of its pictures by no more than `MOST_DISTORTION` of how
    far that is from the middle: of a narrow lens a large k bends little."""
    focal = camera.mean_focal_length() / max(camera.width, camera.height)
    return focal >= options.min_focal_length_ratio and abs(camera.params[3]) * (0.5 / focal) ** 2 <= MOST_DISTORTION


def _fix_lens(colmap, database: Path, options) -> float:
    """Hold the pictures' common lens while they are registered: no distortion, and the focal length of their EXIF data or else of `USUAL`.
    Returns its horizontal angle of view in radians."""
    with colmap.Database.open(database) as opened:
        (camera,) = opened.read_all_cameras()
        focal = camera.params[0] if camera.has_prior_focal_length else max(camera.width, camera.height) / 2 / math.tan(USUAL / 2)
        camera.params = [focal, camera.width / 2, camera.height / 2, 0.0]
        camera.has_prior_focal_length = True  # else COLMAP estimates it for a picture once more
        opened.update_camera(camera)
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
    return 2 * math.atan(camera.width / 2 / focal)


def _with_distortion(colmap, model) -> Any:
    """The model with its lens distortion estimated, which takes all pictures together, at the same focal length; unchanged where the
    distortion exceeds `MOST_DISTORTION`."""
    distorted, options, config = colmap.Reconstruction(model), colmap.BundleAdjustmentOptions(), colmap.BundleAdjustmentConfig()
    options.refine_focal_length = options.refine_principal_point = options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    for image in distorted.images.values():
        if image.has_pose:
            config.add_image(image.image_id)
    config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    colmap.create_default_bundle_adjuster(options, config, distorted).solve()
    distorted.update_point_3d_errors()
    return distorted if all(abs(camera.params[3]) < MOST_DISTORTION for camera in distorted.cameras.values()) else model
