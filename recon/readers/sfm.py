"""Structure from motion through pycolmap, the only module that imports it: COLMAP models are read here as plain arrays."""

from __future__ import annotations

import math
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from recon.log import image_size
from recon.readers.one_lens import is_one_a_picture, share_lenses
from render.progress import Progress

PARTS = ("cameras", "images", "points3D")
EXHAUSTIVE = 40
"""Pictures of which every pair is matched; of more, those that were taken one soon after the other."""

FEATURES = 4096
"""Of a picture whose pose is known, at most: they only have to tell how far things are."""

SEED = 0
"""Of COLMAP's draws, all of them: by its default one set of photos has another lens and other poses each time."""

WIDEST = math.radians(118)
"""Along the longer side, of a lens that nobody told. A street ahead can be squeezed into a wider one that it was not taken with:
nine small photos of `lund` had 124 to 133 degrees by four draws of six, and a pixel of error where their own 70 have half of one."""

USUAL, MORE = math.radians(60), 1.25
"""Angle of view, along the longer side, of a lens that pictures do not tell, between those of phones, dash cameras and cars' own; and
how many times as many pictures it must place as one that is found. A world begins with two or three pictures of a straight way, one behind
the other, which any lens fits, and of a highway half of the pictures fit no more to that one."""

MOST_BENT = 0.5
"""Of a lens, COLMAP's k of a simple radial one: those of dash cameras have some -0.3."""

FEWEST_PLACED = 3
FIX = "COLMAP models, photos and drives without lidar need pycolmap, which is not installed; get it with: pip install 'sidestep[colmap]'"


@dataclass(frozen=True)
class ModelCamera:
    """A calibrated camera: COLMAP's name of its lens model, size in pixels, and that model's parameters in COLMAP's order."""

    lens: str
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """A registered picture: its name below the folder of images, camera, frame of the rig, `cam_from_world` float64 `[4, 4]`, and which
    points it shows, int64 `[P]`."""

    name: str
    camera: int
    frame: int
    cam_from_world: np.ndarray
    points: np.ndarray


@dataclass(frozen=True)
class Model:
    """What structure from motion found, in its own units: cameras by id, pictures in the order of their names, points `[N, 3]`;
    `rigid` where its rigs hold several cameras, so that pictures of one frame were taken at one moment."""

    cameras: dict[int, ModelCamera]
    images: tuple[ModelImage, ...]
    xyz: np.ndarray
    rigid: bool


def pycolmap():
    """The module, its draws begun anew; ModuleNotFoundError's fix as ValueError where it is not installed."""
    try:
        import zlib  # noqa: F401  # first: pycolmap 4.2 brings one of its own, and the interpreter's, loaded after it, crashes

        import pycolmap as module
    except ModuleNotFoundError:
        raise ValueError(FIX) from None
    module.logging.minloglevel = module.logging.Level.FATAL.value
    module.set_random_seed(SEED)
    return module


def is_model(folder: Path) -> bool:
    """Whether a folder holds COLMAP's files, binary or text."""
    return any(all((folder / f"{part}{end}").is_file() for part in PARTS[:2]) for end in (".bin", ".txt"))


def read_model(folder: Path) -> Model:
    """The COLMAP model in `folder`. ValueError where a file is missing, corrupt, or no picture is registered."""
    lost = {end: [p for p in PARTS if not (folder / f"{p}{end}").is_file()] for end in (".bin", ".txt")}
    if all(lost.values()):  # a whole model of one kind is read whatever lies beside it
        end = min(lost, key=lambda end: len(lost[end]))
        raise FileNotFoundError(f"{folder / f'{lost[end][0]}{end}'} is missing; a COLMAP model has {', '.join(p + end for p in PARTS)}")
    try:
        colmap = pycolmap()
        found = colmap.Reconstruction()
        (found.read_text if lost[".bin"] else found.read_binary)(str(folder))
    except (RuntimeError, ValueError, IndexError, MemoryError) as problem:
        if FIX in str(problem):
            raise
        raise ValueError(f"{folder} is not a valid COLMAP model ({_first_line(problem)}); export it again") from None
    if is_one_a_picture(found):
        found = share_lenses(colmap, found, folder)
    place = {key: i for i, key in enumerate(sorted(found.points3D))}
    xyz = np.array([found.points3D[key].xyz for key in place], dtype=np.float64).reshape(-1, 3)
    cameras = {key: ModelCamera(c.model_name, c.width, c.height, tuple(map(float, c.params))) for key, c in found.cameras.items()}
    images = []
    for image in sorted((i for i in found.images.values() if i.has_pose), key=lambda i: i.name):
        pose = np.eye(4)
        pose[:3] = image.cam_from_world().matrix()
        images.append(ModelImage(image.name, image.camera_id, image.frame_id, pose, _shown(image, place)))
    if not images:
        raise ValueError(f"{folder} registers no picture; COLMAP found no pose, so there is nothing to reconstruct from")
    twice = next((a.name for a, b in pairwise(images) if a.name == b.name), None)
    if twice is not None:
        raise ValueError(f"{folder} registers two pictures as {twice}; names in a text model end at their first space: export it as binary")
    values = np.concatenate([xyz.ravel(), *(i.cam_from_world.ravel() for i in images)])
    if not np.isfinite(values).all():
        raise ValueError(f"{folder} holds a pose or a point that is not finite; run COLMAP's mapper again")
    return Model(cameras, tuple(images), xyz, any(len(rig.non_ref_sensors) > 0 for rig in found.rigs.values()))


def solve(pictures: Path, names: list[str], workspace: Path, ordered: bool, angle_of_view: float | None, source: str) -> int:
    """Find the poses of the named pictures and their common lens; writes `workspace`/sparse/0. Returns how many were placed.

    angle_of_view: radians from the left to the right side, where the focal length need not be found; else up to `WIDEST`, and where that
    loses too many pictures, `USUAL` (said). source: where the pictures come from, for messages.
    SIFT features, matched between all pictures, or where they are `ordered` (a video) or many between near ones, then incremental mapping
    (Schönberger and Frahm 2016), all on the CPU. The largest of the models is kept. ValueError where it holds too few pictures.
    """
    colmap = pycolmap()
    database, made = workspace / "database.db", workspace / "models"
    with Progress("structure from motion") as steps:
        steps.step(note="features")
        reader = colmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
        if angle_of_view is not None:
            width, height = image_size(pictures / names[0])
            reader.camera_params = f"{width / 2 / math.tan(angle_of_view / 2)},{width / 2},{height / 2},0"
        _extract(colmap, database, pictures, names, reader, colmap.FeatureExtractionOptions())
        steps.step(note="matches")
        if ordered or len(names) > EXHAUSTIVE:
            _match_following(colmap, database, names)
        else:
            colmap.match_exhaustive(database, verification_options=_verification(colmap), device=colmap.Device.cpu)
        steps.step(note="poses")
        options = _mapping(colmap)
        # two pictures of a drive lie one behind the other, which the defaults do not begin a world with
        options.mapper.init_max_forward_motion, options.mapper.init_min_tri_angle = 1.0, 4.0
        if angle_of_view is None:
            options.min_focal_length_ratio = 0.5 / math.tan(WIDEST / 2)
        options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = angle_of_view is None

        def tell(placed: int) -> None:
            steps.step(0, note=f"poses: {placed} of {len(names)} pictures placed")

        best, count = _largest(colmap, database, pictures, made, options, tell)
        said = ""
        if angle_of_view is None and MORE * count <= len(names):
            angle = f"{math.degrees(_hold_lens(colmap, database, options)):.0f}deg"
            steps.step(0, note=f"poses once more, with a lens of {angle}")
            held, of_held = _largest(colmap, database, pictures, made, options, tell)
            if held is not None and of_held >= max(MORE * count, FEWEST_PLACED):
                which = f"a lens of {angle} places {of_held} of {len(names)}, one that is found {count}"
                fix = f"lengths along its way are right as far as {angle} are: give --angle-of-view where it is known"
                said = f"{source}: its pictures do not tell how wide its camera sees: {which}; {fix}"
                best, count = _bent(colmap, held), of_held
    if said:
        print(said, file=sys.stderr)
    if best is None or count < max(FEWEST_PLACED, len(names) // 4):
        fix = "take them closer together, with more overlap and things that stand still"
        raise ValueError(f"only {count} of {len(names)} pictures of {source} could be placed; {fix}")
    (workspace / "sparse" / "0").mkdir(parents=True)
    best.write(workspace / "sparse" / "0")
    database.unlink()
    return count


def _largest(colmap, database: Path, pictures: Path, made: Path, options, tell: Callable[[int], None]) -> tuple[Any, int]:
    """The model that places the most pictures, None for none, and how many those are; `tell` is told meanwhile."""
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


def _hold_lens(colmap, database: Path, options) -> float:
    """Have the pictures' one lens bend nothing and stay so while they are placed, `USUAL` where they do not say their own in EXIF. Returns
    its angle of view, from the left to the right side."""
    with colmap.Database.open(database) as opened:
        (camera,) = opened.read_all_cameras()
        focal = camera.params[0] if camera.has_prior_focal_length else max(camera.width, camera.height) / 2 / math.tan(USUAL / 2)
        camera.params = [focal, camera.width / 2, camera.height / 2, 0.0]
        opened.update_camera(camera)
    options.ba_refine_focal_length = options.mapper.abs_pose_refine_focal_length = False
    options.ba_refine_extra_params = options.mapper.abs_pose_refine_extra_params = False
    return 2 * math.atan(camera.width / 2 / focal)


def _bent(colmap, model) -> Any:
    """The model, with how its lens bends found by all pictures together, which two do not tell, its focal length held; as it is where that
    is more than lenses do (`MOST_BENT`)."""
    bent, options, config = colmap.Reconstruction(model), colmap.BundleAdjustmentOptions(), colmap.BundleAdjustmentConfig()
    options.refine_focal_length = options.refine_principal_point = options.print_summary = False
    options.ceres.solver_options.num_threads = 1
    options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
    for image in bent.images.values():
        if image.has_pose:
            config.add_image(image.image_id)
    config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    colmap.create_default_bundle_adjuster(options, config, bent).solve()
    bent.update_point_3d_errors()
    return bent if all(abs(camera.params[3]) < MOST_BENT for camera in bent.cameras.values()) else model


@dataclass(frozen=True)
class Posed:
    """Pictures of known poses, in `workspace`/images. lenses: by folder of pictures COLMAP's name of their lens model, and its parameters;
    poses: by a picture's name, as camera/000001.png, `cam_from_world` float64 `[4, 4]`; pairs: of pictures that show the same."""

    workspace: Path
    lenses: dict[str, tuple[str, tuple[float, ...]]]
    poses: dict[str, np.ndarray]
    pairs: list[tuple[str, str]]


def triangulate(posed: Posed) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Points `[N, 3]` that pictures show at their poses, and by name which of them each shows.

    SIFT features, matched between pairs, and triangulated with the poses held (Schönberger and Frahm 2016), all on the CPU.
    """
    colmap = pycolmap()
    with Progress("points from pictures") as steps:
        _follow(colmap, posed, steps)
        steps.step(note="depths")
        found = _at_poses(colmap, posed.workspace, posed.poses)
    place = {key: i for i, key in enumerate(sorted(found.points3D))}
    xyz = np.array([found.points3D[key].xyz for key in place], dtype=np.float64).reshape(-1, 3)
    nothing = dict.fromkeys(posed.poses, np.zeros(0, np.int64))
    return xyz, nothing | {image.name: _shown(image, place) for image in found.images.values()}


def adjust(posed: Posed, spread: float) -> tuple[dict[str, np.ndarray], float, float]:
    """Poses by which pictures meet in the points that they show, by name; how far off these points are seen by the poses given, and by
    those, in the mean in pixels.

    Bundle adjustment (Triggs et al. 2000) with a robust loss, points and poses free, from and about the poses given, whose places are
    likely to be off by `spread` metres. Pictures that match no other are left out. spread holds the world: of its turn, which on a
    straight path places do not tell, the turn by which poses differ in the mean is taken out.
    """
    colmap = pycolmap()
    with Progress("poses from pictures") as steps:
        _follow(colmap, posed, steps)
        steps.step(note="poses")
        found = _at_poses(colmap, posed.workspace, posed.poses)
        before = found.compute_mean_reprojection_error()
        options, config, priors = colmap.BundleAdjustmentOptions(), colmap.BundleAdjustmentConfig(), []
        options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
        options.refine_sensor_from_rig = options.print_summary = False
        options.ceres.solver_options.num_threads = 1
        options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
        for image in found.images.values():
            config.add_image(image.image_id)
            place = np.linalg.inv(posed.poses[image.name])[:3, 3]
            prior = colmap.PosePrior(position=place, position_covariance=np.eye(3) * spread**2)
            prior.corr_data_id, prior.coordinate_system = image.data_id, colmap.PosePriorCoordinateSystem.CARTESIAN
            priors.append(prior)
        if len(priors) > 2:
            told = colmap.PosePriorBundleAdjustmentOptions()
            colmap.create_pose_prior_bundle_adjuster(options, told, config, priors, found).solve()
        found.update_point_3d_errors()
    after = {image.name: np.vstack([image.cam_from_world().matrix(), [0, 0, 0, 1]]) for image in found.images.values()}
    return _unturned(after, posed.poses), before, found.compute_mean_reprojection_error()


def _unturned(poses: dict[str, np.ndarray], as_given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Poses `cam_from_world`, turned and moved as a whole to lie as those given do in the mean."""
    if not poses:
        return poses
    new, old = (np.linalg.inv(np.stack([of[name] for name in poses])) for of in (poses, as_given))
    u, _, v = np.linalg.svd((old[:, :3, :3] @ new[:, :3, :3].transpose(0, 2, 1)).sum(0))
    back = np.eye(4)
    back[:3, :3] = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    back[:3, 3] = old[:, :3, 3].mean(0) - back[:3, :3] @ new[:, :3, 3].mean(0)
    return dict(zip(poses, np.linalg.inv(back @ new), strict=True))


def _follow(colmap, posed: Posed, steps: Progress) -> None:
    """Find the pictures' features and match them; `workspace`/database.db holds both."""
    database, extraction = posed.workspace / "database.db", colmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = FEATURES
    for folder, (lens, params) in posed.lenses.items():
        steps.step(note=f"features of {folder}")
        names = [name for name in posed.poses if name.startswith(f"{folder}/")]
        reader = colmap.ImageReaderOptions(camera_model=lens, camera_params=",".join(map(repr, params)))
        _extract(colmap, database, posed.workspace / "images", names, reader, extraction)
    steps.step(note="matches")
    listed = posed.workspace / "pairs.txt"
    listed.write_text("".join(f"{a} {b}\n" for a, b in posed.pairs))
    pairing, verification = colmap.ImportedPairingOptions(match_list_path=str(listed)), _verification(colmap)
    colmap.match_image_pairs(database, pairing_options=pairing, verification_options=verification, device=colmap.Device.cpu)


def _extract(colmap, database: Path, pictures: Path, names: list[str], reader, extraction) -> None:
    """Find the named pictures' features. They are written down first, in their order: threads would do so as they get ready, and what is
    found hangs on it."""
    single = colmap.CameraMode.SINGLE
    colmap.Database.open(database).close()
    colmap.import_images(database, pictures, single, names, reader)
    colmap.extract_features(database, pictures, names, single, reader, extraction, device=colmap.Device.cpu)


def _mapping(colmap):
    """How points and poses are found. Threads would try pairs to begin with and add up in any order, and lenses come out 5 % apart."""
    options = colmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = SEED, 1
    return options


def _verification(colmap):
    """How matches are tested against the geometry of two views."""
    options = colmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    return options


def _match_following(colmap, database: Path, names: list[str]) -> None:
    """Match the features of pictures that follow each other in the order of `names`."""

    def rename(called: dict[str, str]) -> None:
        with colmap.Database.open(database) as opened:
            for image in opened.read_all_images():
                image.name = called[image.name]
                opened.update_image(image)

    in_order = {name: f"{i:08d}" for i, name in enumerate(names)}  # COLMAP goes by the alphabet, where 10.jpg comes before 9.jpg
    rename(in_order)
    colmap.match_sequential(database, verification_options=_verification(colmap), device=colmap.Device.cpu)
    rename({number: name for name, number in in_order.items()})


def _at_poses(colmap, workspace: Path, poses: dict[str, np.ndarray]):
    """COLMAP's reconstruction of those of the database's pictures that match any other, at their poses, and of what they show."""
    found, database = colmap.Reconstruction(), workspace / "database.db"
    with colmap.Database.open(database) as opened:
        found.load(colmap.DatabaseCache.create(opened, colmap.DatabaseCacheOptions()))
    for image in found.images.values():
        image.frame.set_cam_from_world(image.camera_id, colmap.Rigid3d(poses[image.name][:3]))
        found.register_frame(image.frame_id)
    if len(found.images) > 1:
        (workspace / "found").mkdir()
        options = _mapping(colmap)
        found = colmap.triangulate_points(found, database, workspace / "images", workspace / "found", options=options)
    return found


def _shown(image, place: dict[int, int]) -> np.ndarray:
    """Which points a registered picture shows, by their places."""
    points = [place[p.point3D_id] for p in image.get_observation_points2D() if p.point3D_id in place]
    return np.unique(np.array(points, dtype=np.int64))


def _first_line(problem: Exception) -> str:
    return (str(problem).strip().splitlines() or ["it does not parse"])[-1][:160]
