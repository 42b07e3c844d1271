"""Lenses, one a file: how a point in the camera becomes a pixel, and a pixel a ray."""

from scenes.lenses.equirectangular import Equirectangular
from scenes.lenses.fisheye import Fisheye
from scenes.lenses.ftheta import FTheta
from scenes.lenses.lens import Lens
from scenes.lenses.opencv import OpenCV
from scenes.lenses.orthographic import Orthographic
from scenes.lenses.pinhole import Pinhole

LENSES: dict[str, type[Lens]] = {lens.kind: lens for lens in (Pinhole, OpenCV, Fisheye, FTheta, Equirectangular, Orthographic)}
"""The lenses by their name in files."""

__all__ = ["LENSES", "Equirectangular", "FTheta", "Fisheye", "Lens", "OpenCV", "Orthographic", "Pinhole"]
