"""Pictures of known poses: points that are triangulated from them, and poses corrected by bundle adjustment, all on the CPU."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from recon.log import Log
from recon.sfm.colmap import extract_features, mapping_options, pycolmap, verification_options, visible_points
from render.progress import Progress
from scenes.lenses import Fisheye, Lens, OpenCV, Pinhole
from scenes.poses import inverse, nearest_rotation

FEATURES = 4096
"""At most, of a picture: where poses are known, features only have to give depths."""

AHEAD = (1, 2, 4, 8)
"""Steps between the pictures of a camera that are matched: near ones look alike, far ones determine depth."""


@dataclass(frozen=True)
class Posed:
    """Pictures of known poses, in `workspace`/images. lenses: by camera COLMAP's name of the lens model, and its parameters; poses: by a
    picture's name (`picture_name`) `cam_from_world` float64 `[4, 4]`; pairs: names of the pictures that are matched."""

    workspace: Path
    lenses: dict[str, tuple[str, tuple[float, ...]]]
    poses: dict[str, np.ndarray]
    pairs: list[tuple[str, str]]

    @staticmethod
    def written(workspace: Path, log: Log, pictures: Iterable[tuple[str, int, np.ndarray]], pairs: list[tuple[str, str]]) -> Posed:
        """Pictures uint8 `[H, W, 3]` of cameras at indices, written to a workspace, with the log's poses, and its lenses at the pictures'
        size. ValueError for lenses that COLMAP does not have."""
        lenses, poses = {}, {}
        for name, index, image in pictures:
            camera = log.camera(name).camera(index, image.shape[1], image.shape[0])
            file = workspace / "images" / picture_name(name, index)
            file.parent.mkdir(parents=True, exist_ok=True)
            Image.fromarray(image).save(file, compress_level=1)
            lenses[name] = colmap_lens(camera.lens, log.path)
            poses[picture_name(name, index)] = inverse(camera.world_from_cam).numpy()
        return Posed(workspace, lenses, poses, pairs)


def picture_name(camera: str, index: int) -> str:
    """Of a camera's picture in a workspace, as front/000001.png."""
    return f"{camera}/{index:06d}.png"


def colmap_lens(lens: Lens, where: Path) -> tuple[str, tuple[float, ...]]:
    """COLMAP's lens model for ours, and its parameters: the reverse of `lens_of` in recon/readers/colmap.py. where: the drive's folder, for
    messages. ValueError for lenses that COLMAP does not have."""
    model = {Pinhole: "PINHOLE", OpenCV: "FULL_OPENCV", Fisheye: "OPENCV_FISHEYE"}.get(type(lens))
    params = tuple(lens.params().tolist())
    if model == "FULL_OPENCV" and not any(params[12:]):
        params = params[:12]
    elif model in (None, "FULL_OPENCV"):
        what = f"lens {lens.kind}" + " with thin prisms" * (model is not None)
        raise ValueError(f"{where} has no lidar, and COLMAP, which would find depths in its pictures, knows no {what}; add lidar")
    return model, params


def triangulate(posed: Posed) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Points float64 `[N, 3]` of the pictures at their poses, and by picture name which of them each shows, int64 `[P]`.

    SIFT features are matched between the pairs and triangulated, with the poses held (Schönberger and Frahm 2016).
    """
    colmap = pycolmap()
    with Progress("points from pictures") as steps:
        _match(colmap, posed, steps)
        steps.step(note="depths")
        found = _at_poses(colmap, posed.workspace, posed.poses)
    place = {key: i for i, key in enumerate(sorted(found.points3D))}
    xyz = np.array([found.points3D[key].xyz for key in place], dtype=np.float64).reshape(-1, 3)
    nothing = dict.fromkeys(posed.poses, np.zeros(0, np.int64))
    return xyz, nothing | {image.name: visible_points(image, place) for image in found.images.values()}


def adjust(posed: Posed, spread: float) -> tuple[dict[str, np.ndarray], float, float]:
    """Corrected poses by picture name, and the mean reprojection errors in pixels before and after.

    Bundle adjustment (Triggs et al. 2000) with a robust loss over points and poses, which starts from the given poses; their positions are
    priors with a standard deviation of `spread` metres. Pictures that match no other are left out. The priors fix the gauge except for the
    rotation about a straight path, so the mean rotation between old and new poses is taken out.
    """
    colmap = pycolmap()
    with Progress("poses from pictures") as steps:
        _match(colmap, posed, steps)
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
    return _aligned(after, posed.poses), before, found.compute_mean_reprojection_error()


def _match(colmap, posed: Posed, steps: Progress) -> None:
    """Extract the pictures' features and match the pairs; `workspace`/database.db holds both."""
    database, extraction = posed.workspace / "database.db", colmap.FeatureExtractionOptions()
    extraction.sift.max_num_features = FEATURES
    for folder, (lens, params) in posed.lenses.items():
        steps.step(note=f"features of {folder}")
        names = [name for name in posed.poses if name.startswith(f"{folder}/")]
        reader = colmap.ImageReaderOptions(camera_model=lens, camera_params=",".join(map(repr, params)))
        extract_features(colmap, database, posed.workspace / "images", names, reader, extraction)
    steps.step(note="matches")
    listed = posed.workspace / "pairs.txt"
    listed.write_text("".join(f"{a} {b}\n" for a, b in posed.pairs))
    pairing, verification = colmap.ImportedPairingOptions(match_list_path=str(listed)), verification_options(colmap)
    colmap.match_image_pairs(database, pairing_options=pairing, verification_options=verification, device=colmap.Device.cpu)


def _at_poses(colmap, workspace: Path, poses: dict[str, np.ndarray]):
    """COLMAP's reconstruction of those pictures in the database that match any other, registered at their poses, with points triangulated
    from them."""
    found, database = colmap.Reconstruction(), workspace / "database.db"
    with colmap.Database.open(database) as opened:
        found.load(colmap.DatabaseCache.create(opened, colmap.DatabaseCacheOptions()))
    for image in found.images.values():
        image.frame.set_cam_from_world(image.camera_id, colmap.Rigid3d(poses[image.name][:3]))
        found.register_frame(image.frame_id)
    if len(found.images) > 1:
        (workspace / "found").mkdir()
        options = mapping_options(colmap)
        found = colmap.triangulate_points(found, database, workspace / "images", workspace / "found", options=options)
    return found


def _aligned(poses: dict[str, np.ndarray], given: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Poses `cam_from_world`, moved together by the one rigid motion that gives them the mean rotation and position of the given ones."""
    if not poses:
        return poses
    new, old = (np.linalg.inv(np.stack([of[name] for name in poses])) for of in (poses, given))
    back = np.eye(4)
    back[:3, :3] = nearest_rotation(torch.from_numpy((old[:, :3, :3] @ new[:, :3, :3].transpose(0, 2, 1)).mean(0))).numpy()
    back[:3, 3] = old[:, :3, 3].mean(0) - back[:3, :3] @ new[:, :3, 3].mean(0)
    return dict(zip(poses, np.linalg.inv(back @ new), strict=True))
