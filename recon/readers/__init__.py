"""Which reader reads a folder: one line a layout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from recon.log import Log
from recon.readers.argoverse2 import is_argoverse2, read_argoverse2
from recon.readers.colmap import find_model, read_colmap
from recon.readers.kitti_odometry import is_kitti_odometry, read_kitti_odometry
from recon.readers.kitti_raw import is_kitti_raw, lacks_oxts, read_kitti_raw
from recon.readers.ncore import is_ncore, read_ncore
from recon.readers.nuscenes import is_nuscenes, read_nuscenes
from recon.readers.pandaset import is_pandaset, read_pandaset
from recon.readers.photos import check_enough, in_subfolders, is_photos, is_video, read_photos
from recon.readers.recorder import without_recorder
from recon.readers.waymo import is_waymo, read_waymo
from recon.sound import sound


def open_log(
    path: str | Path,
    camera_height: float | None = None,
    metres_per_unit: float | None = None,
    angle_of_view: float | None = None,
    part_us: tuple[int, int | None] = (0, None),
) -> Log:
    """The drive in a folder, by the layout of its files, or a video; reads no image and no sweep yet, but of photos
    and videos whose poses must be found first.

    camera_height, metres_per_unit: what makes a world that pictures alone made metric: metres of the cameras above the ground, or
    metres a unit of the model. angle_of_view: radians from the left to the right side of photos or a video, found where None. part_us:
    start and duration of the part of a video that is read; others are read whole. Raises
    FileNotFoundError where there is no such folder and ValueError where its layout is not known, a file is corrupt, or metres or an angle
    are given to a log that has its own.
    """
    path = Path(path)
    if path.name in ("", ".."):
        path = path.resolve()  # what is found is kept beside it, under its name
    read = metric_reader(path)
    if read is not None:
        given = "--camera-height" if camera_height is not None else "--metres-per-unit" if metres_per_unit is not None else ""
        if given:
            raise ValueError(f"{path} is in metres already; leave out {given}, which is for COLMAP folders, photos and videos")
        _knows_its_lenses(path, angle_of_view)
        return without_recorder(sound(read(path)))
    if is_video(path):
        return sound(read_photos(path, camera_height, metres_per_unit, angle_of_view, part_us))
    if not path.is_dir():
        check_enough(path)
        raise FileNotFoundError(f"{path} is neither a folder nor a video; give the folder of one drive, as pandaset/002")
    if find_model(path) is not None:
        _knows_its_lenses(path, angle_of_view)
        return sound(read_colmap(path, camera_height, metres_per_unit))
    if is_photos(path):
        return sound(read_photos(path, camera_height, metres_per_unit, angle_of_view))
    if lacks_oxts(path):
        raise FileNotFoundError(f"{path / 'oxts'} is missing; it says where a KITTI drive's car was: fetch it too")
    inside = sorted(p for level in ("*", "*/*") for p in path.glob(level) if p.is_dir() and metric_reader(p))
    if not inside:
        check_enough(path)
    hint = f" Did you mean {inside[0]}?" if inside else in_subfolders(path)
    raise ValueError(f"{path} is not a known layout of a drive: {', '.join(f'{name} has {what}' for name, what in LAYOUTS.items())}.{hint}")


def _knows_its_lenses(path: Path, angle_of_view: float | None) -> None:
    if angle_of_view is not None:
        raise ValueError(f"{path} has a calibration of its own; leave out --angle-of-view, which is for photos and videos")


READERS: dict[str, tuple[Callable[[Path], bool], Callable[[Path], Log]]] = {
    "PandaSet": (is_pandaset, read_pandaset),
    "nuScenes": (is_nuscenes, read_nuscenes),
    "Argoverse 2": (is_argoverse2, read_argoverse2),
    "Waymo": (is_waymo, read_waymo),
    "NCore": (is_ncore, read_ncore),
    "KITTI raw": (is_kitti_raw, read_kitti_raw),
    "KITTI odometry": (is_kitti_odometry, read_kitti_odometry),
}
"""Readers of logs with metres of their own: whether a path is one, and what reads it."""

LAYOUTS = {
    "PandaSet": "camera/",
    "nuScenes": "samples/ and v1.0-*/ (name a scene, as nuscenes/scene-0061)",
    "Argoverse 2": "city_SE3_egovehicle.feather",
    "Waymo": "camera_image/ and vehicle_pose/ (name a segment in it)",
    "NCore": "a sequence's .json that names its component stores",
    "KITTI raw": "oxts/ and image_02/",
    "KITTI odometry": "calib.txt and times.txt",
    "COLMAP": "cameras.bin, images.bin and points3D.bin",
    "a folder of photos": "three .jpg, .png or .tif at least",
}


def metric_reader(path: Path) -> Callable[[Path], Log] | None:
    """What reads a path that has metres of its own; None where it is another layout."""
    return next((read for is_one, read in READERS.values() if is_one(path)), None)
