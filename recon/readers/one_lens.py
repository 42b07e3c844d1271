"""Photos that COLMAP gave a lens each, as it does unless told otherwise, though one camera took them: they share one lens here.

Lenses that differ photo by photo are no rig, and their focal lengths, each found from one picture, trade against its distance. So the
photos of one size get one lens, the middle of theirs, and it, the poses and the points are adjusted to each other once more (bundle
adjustment, Triggs et al. 2000).
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path
from typing import Any

import numpy as np

from recon.readers.order import names_apart
from render.progress import Progress

WORSE = 2.0, 1.0
"""By how many times, and at least how many pixels, points may be seen farther off through one lens than each through its own."""

FIX = "Let COLMAP find one for those of one lens: colmap feature_extractor --ImageReader.single_camera_per_folder 1"


FEW = 5
"""Pictures to a camera, below which they are no rig's unless their names tell its cameras apart."""


def is_one_a_picture(found) -> bool:
    """Whether nearly every registered picture of a COLMAP reconstruction, or every `FEW`, has a camera of its own, and they are no rig."""
    taken: dict[int, list[str]] = defaultdict(list)
    for image in found.images.values():
        if image.has_pose:
            taken[image.camera_id].append(image.name)
    pictures, rigid = sum(map(len, taken.values())), any(len(rig.non_ref_sensors) > 0 for rig in found.rigs.values())
    if len(taken) < 2 or rigid:
        return False
    return pictures < 2 * len(taken) or (pictures < FEW * len(taken) and names_apart(taken) is None)


def share_lenses(colmap, found, folder: Path):
    """The reconstruction, read from `folder`, with one lens for all registered pictures of a size and lens model. ValueError where one
    lens does not suit them, or no points tell how to adjust the poses to it."""
    shared, lens_of = _with_shared(colmap, found)
    if all(np.allclose(found.cameras[key].params, shared.cameras[lens].params, rtol=1e-6) for key, lens in lens_of.items()):
        return shared
    if not shared.points3D:
        raise ValueError(f"{folder} has a camera for each picture or few and no points by which they could share one; {FIX}")
    found.update_point_3d_errors()
    before = found.compute_mean_reprojection_error()
    with Progress("one lens") as steps:
        steps.step(note=f"for {len(shared.images)} pictures that have one each")
        options, config = colmap.BundleAdjustmentOptions(), colmap.BundleAdjustmentConfig()
        options.print_summary = options.refine_principal_point = False
        options.ceres.loss_function_type = colmap.LossFunctionType.CAUCHY
        for key in shared.images:
            config.add_image(key)
        config.fix_gauge(colmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
        colmap.create_default_bundle_adjuster(options, config, shared).solve()
        shared.update_point_3d_errors()
        after = shared.compute_mean_reprojection_error()
        steps.step(note=f"points are {before:.2f} pixels off with one each, {after:.2f} with one for all")
    if not after < max(WORSE[0] * before, before + WORSE[1]):
        what = f"its points are {before:.3g} pixels off, with one for all {after:.3g}"
        raise ValueError(f"{folder} has a lens for each picture or few, {what}: they are of several lenses, or zoomed. {FIX}")
    return shared


def _with_shared(colmap, found) -> tuple[Any, dict[int, int]]:
    """The registered pictures and points of a reconstruction, cameras alike replaced by their middle; which camera stands for which."""
    alike: dict[tuple, list[int]] = defaultdict(list)
    for key in sorted({image.camera_id for image in found.images.values() if image.has_pose}):
        camera = found.cameras[key]
        alike[camera.model_name, camera.width, camera.height].append(key)
    shared = colmap.Reconstruction()
    lens_of: dict[int, int] = {}
    for (model, width, height), keys in alike.items():
        middle = np.median([found.cameras[key].params for key in keys], axis=0)
        shared.add_camera_with_trivial_rig(colmap.Camera(camera_id=keys[0], model=model, width=width, height=height, params=middle))
        lens_of |= dict.fromkeys(keys, keys[0])
    for key, image in sorted(found.images.items()):
        if image.has_pose:
            seen = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
            copy = colmap.Image(name=image.name, keypoints=seen, camera_id=lens_of[image.camera_id], image_id=key)
            shared.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in found.points3D.values():
        track = colmap.Track([e for e in point.track.elements if e.image_id in shared.images])
        if track.length() > 1:
            shared.add_point3D(point.xyz, track, point.color)
    return shared, lens_of
