"""Poses and a common lens for pictures that have neither: structure from motion (Schönberger and Frahm 2016), all on the CPU."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

from recon.log import image_size
from recon.sfm.colmap import extract_features, mapping_options, pycolmap, verification_options
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

BEGUN_WITHIN = 1 / 240
"""Part of a picture's longer side by which points may be off in the two that a model begins with, unless that places too few. COLMAP's 4
pixels are so much of a small picture that a pair passes which was turned, as is found, where it moved, and the others are placed along: 12
rendered pictures of 480x270, of a known lens, came out turned by 22 to 29 degrees in four of eight cases, now by 0.1 in all."""

FEWEST_PLACED = 3
"""Pictures that must be registered at least."""


def solve(pictures: Path, names: list[str], workspace: Path, ordered: bool, angle_of_view: float | None, source: str) -> int:
    """Find the poses of the named files in the folder `pictures` and their common lens; writes `workspace`/sparse/0. Returns how many
    pictures were registered.

    ordered: whether `names` follow each other in time, as the frames of a video. angle_of_view: horizontal, in radians; where None the
    focal length is estimated, up to `WIDEST`, and where that registers too few pictures, `USUAL` is assumed and reported on stderr.
    source: where the pictures come from, for messages.

    SIFT features are matched between all pairs, or between pictures near each other in `names` where these are `ordered` or many, and
    incremental mapping registers the pictures; the largest of its models is kept. ValueError where it has too few pictures.
    """
    colmap = pycolmap()
    database, models = workspace / "database.db", workspace / "models"
    with Progress("structure from motion") as steps:
        steps.step(note="features")
        reader = colmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        if angle_of_view is not None:
            width, height = image_size(pictures / names[0])
            reader.camera_params = f"{width / 2 / math.tan(angle_of_view / 2)},{width / 2},{height / 2},0"
        extract_features(colmap, database, pictures, names, reader, colmap.FeatureExtractionOptions())
        steps.step(note="matches")
        if ordered or len(names) > EXHAUSTIVE:
            _match_neighbours(colmap, database, names)
        else:
            colmap.match_exhaustive(database, verification_options=verification_options(colmap), device=colmap.Device.cpu)
        steps.step(note="poses")
        options = _solving_options(colmap, angle_of_view)

        def tell(placed: int) -> None:
            steps.step(0, note=f"poses: {placed} of {len(names)} pictures placed")

        usual_error = options.mapper.init_max_error
        options.mapper.init_max_error = min(usual_error, BEGUN_WITHIN * max(image_size(pictures / names[0])))
        best, count = _largest(colmap, database, pictures, models, options, tell)
        if options.mapper.init_max_error < usual_error and MORE * count <= len(names):
            options.mapper.init_max_error = usual_error
            best, count = max((best, count), _largest(colmap, database, pictures, models, options, tell), key=lambda found: found[1])
        said = ""
        if angle_of_view is None and MORE * count <= len(names):
            angle = f"{math.degrees(_fix_lens(colmap, database, options)):.0f}deg"
            steps.step(0, note=f"poses once more, with a lens of {angle}")
            usual, of_usual = _largest(colmap, database, pictures, models, options, tell)
            if usual is not None and of_usual >= max(MORE * count, FEWEST_PLACED):
                which = f"a lens of {angle} places {of_usual} of {len(names)}, one that is found {count}"
                fix = f"lengths along its way are right as far as {angle} are: give --angle-of-view where it is known"
                said = f"{source}: its pictures do not tell how wide its camera sees: {which}; {fix}"
                best, count = _with_distortion(colmap, usual), of_usual
    if said:
        print(said, file=sys.stderr)
    if best is None or count < max(FEWEST_PLACED, len(names) // 4):
        fix = "take them closer together, with more overlap and things that stand still, while the camera moves"
        raise ValueError(f"only {count} of {len(names)} pictures of {source} could be placed; {fix}")
    (workspace / "sparse" / "0").mkdir(parents=True)
    best.write(workspace / "sparse" / "0")
    database.unlink()
    return count


def _match_neighbours(colmap, database: Path, names: list[str]) -> None:
    """Match the features of pictures that are near each other in the order of `names`."""

    def rename(called: dict[str, str]) -> None:
        with colmap.Database.open(database) as opened:
            for image in opened.read_all_images():
                image.name = called[image.name]
                opened.update_image(image)

    in_order = {name: f"{i:08d}" for i, name in enumerate(names)}  # COLMAP goes by the alphabet, where 10.jpg comes before 9.jpg
    rename(in_order)
    colmap.match_sequential(database, verification_options=verification_options(colmap), device=colmap.Device.cpu)
    rename({number: name for name, number in in_order.items()})


def _solving_options(colmap, angle_of_view: float | None):
    """Options of incremental mapping, with the focal length held where the angle of view is known."""
    options = mapping_options(colmap)
    # two pictures of a drive lie one behind the other, and the defaults do not begin a model with such a pair
    options.mapper.init_max_forward_motion, options.mapper.init_min_tri_angle = 1.0, 4.0
    if angle_of_view is None:
        options.min_focal_length_ratio = 0.5 / math.tan(WIDEST / 2)
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = angle_of_view is None
    return options


def _largest(colmap, database: Path, pictures: Path, made: Path, options, tell: Callable[[int], None]) -> tuple[Any, int]:
    """The model with the most registered pictures, None for none, and how many it has; `tell` is called with that number as it grows."""
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
    best = max(models.values(), key=lambda m: m.num_reg_images(), default=None)
    return best, 0 if best is None else best.num_reg_images()


def _fix_lens(colmap, database: Path, options) -> float:
    """Hold the pictures' common lens while they are registered: no distortion, and the focal length of their EXIF data or else of `USUAL`.
    Returns its horizontal angle of view in radians."""
    with colmap.Database.open(database) as opened:
        (camera,) = opened.read_all_cameras()
        focal = camera.params[0] if camera.has_prior_focal_length else max(camera.width, camera.height) / 2 / math.tan(USUAL / 2)
        camera.params = [focal, camera.width / 2, camera.height / 2, 0.0]
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
