"""Which pixels are sky."""

from __future__ import annotations

import numpy as np
from scipy import ndimage


def sky_mask(image: np.ndarray) -> np.ndarray:
    """Pixels `[H, W]` of a uint8 image that are surely sky: smooth, bright enough, bluish, and joined to the image's top row."""
    rgb = ndimage.uniform_filter(image.astype(np.float32), (3, 3, 1))
    grey = rgb.mean(-1)
    edge = np.hypot(ndimage.sobel(grey, 0), ndimage.sobel(grey, 1)) / 8
    smooth = (edge < 3.0) & (rgb[..., 2] > rgb[..., 0] + 2) & (grey > 90)
    label, _ = ndimage.label(smooth)
    large = np.bincount(label.ravel()) > 1e-3 * grey.size
    top = np.array([k for k in np.unique(label[:3][smooth[:3]]) if large[k]], dtype=label.dtype)
    # beyond the edge nothing closes, so the edge is repeated
    return ndimage.binary_closing(np.pad(np.isin(label, top), 4, mode="edge"), iterations=2)[4:-4, 4:-4]


def like_sky(image: np.ndarray, sky: np.ndarray) -> np.ndarray:
    """The sky and what looks like the nearest of it: gaps between leaves and wires, where splats of its colour would float."""
    if not sky.any():
        return sky
    rgb = ndimage.uniform_filter(image.astype(np.float32), (3, 3, 1))
    away, nearest = ndimage.distance_transform_edt(~sky, return_indices=True)
    return sky | ((np.abs(rgb - rgb[tuple(nearest)]).max(-1) < 14) & (away < 40))
