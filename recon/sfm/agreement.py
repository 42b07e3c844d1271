"""Whether a model is of the world that its pictures show, told by what they share of it, not by what the model kept."""

from __future__ import annotations

from pathlib import Path

import numpy as np

WITHIN = 1 / 960
"""Part of a picture's longer side by which a match may be off what a model says of it."""

AGREED = 0.5
"""Agreement from which on a model is taken to be right."""


def agreement(colmap, database: Path, model, longer: int) -> float:
    """The part of the matches between a model's pictures, `longer` pixels along their longer side, that lie as near as `WITHIN` to its
    epipolar lines (Sampson 1982): the mean over all pairs of pictures whose matches were verified in the database; 0 where no pair was.

    A model's own reprojection errors tell less: what does not fit it is no longer among its points. Matches that were verified fit some
    motion of two cameras each, and all of them a right model's.
    """
    placed = {image.image_id: image for image in model.images.values() if image.has_pose}
    shares = []
    with colmap.Database.open(database) as opened:
        rays = {}
        for key, image in placed.items():
            camera = model.cameras[image.camera_id]
            seen = camera.cam_from_img(opened.read_keypoints(key)[:, :2].astype(np.float64))
            rays[key] = np.column_stack([seen, np.ones(len(seen))])
        for pair, geometry in zip(*opened.read_two_view_geometries(), strict=True):
            first, second = colmap.pair_id_to_image_pair(pair)
            matches = geometry.inlier_matches
            if not len(matches) or first not in placed or second not in placed:
                continue
            essential = colmap.essential_matrix_from_pose(placed[second].cam_from_world() * placed[first].cam_from_world().inverse())
            a, b = rays[first][matches[:, 0]], rays[second][matches[:, 1]]
            lines, back = a @ essential.T, b @ essential
            off = np.abs((b * lines).sum(1)) / np.sqrt((lines[:, :2] ** 2 + back[:, :2] ** 2).sum(1).clip(1e-24))
            shares.append((off * model.cameras[placed[first].camera_id].mean_focal_length() < WITHIN * longer).mean())
    return float(np.mean(shares)) if shares else 0.0
