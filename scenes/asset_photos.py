"""The photos of an asset beside its file: for asset.usdc the folder asset.photos, with photos.json and a WebP picture each."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import torch

from scenes.asset import AssetPhoto
from scenes.atomic import atomic_folder
from scenes.camera import Camera
from scenes.lenses import Pinhole

INDEX = "photos.json"
QUALITY = 92


def photos_folder(file: Path) -> Path:
    """Where the photos of the asset in a file lie."""
    return file.with_suffix(".photos")


@contextmanager
def photos_beside(file: Path, photos: Sequence[AssetPhoto]) -> Iterator[None]:
    """Within the block the asset is written to `file`; then its photos lie beside it, all or none, in place of those that lay there. Where
    the block fails these stay. A folder that is not one of photos is never replaced: FileExistsError where photos would go there. Lenses
    must be pinholes: ValueError. Both are raised before the block."""
    from PIL import Image

    folder = photos_folder(file)
    if not photos:
        yield
        if _holds_photos(folder):
            shutil.rmtree(folder, ignore_errors=True)
        return
    if folder.exists() and not _holds_photos(folder):
        raise FileExistsError(
            f"{folder} holds something else than photos of an asset, so it is left alone; move it, or give {file.name} another name"
        )
    with atomic_folder(folder, replace=True) as half:
        told = []
        for i, photo in enumerate(photos):
            camera, lens = photo.camera, photo.camera.lens
            if not isinstance(lens, Pinhole):
                raise ValueError(f"photo {i} of {file} has the lens {lens.kind}; photos of assets are kept as pinhole views")
            name = f"{i:02d}.webp"
            Image.fromarray(photo.read()).save(half / name, "WEBP", quality=QUALITY, method=4)
            told.append(
                {
                    "file": name, "width": camera.width, "height": camera.height, "pinhole": [float(v) for v in lens.params()],
                    "asset_from_cam": camera.world_from_cam.tolist(), "time_us": camera.time_us,
                }
            )  # fmt: skip
        (half / INDEX).write_text(json.dumps(told, indent=1), encoding="utf-8")
        yield


def _holds_photos(folder: Path) -> bool:
    """Whether a folder holds the photos of an asset and nothing else."""
    names = {entry.name for entry in folder.iterdir()} if folder.is_dir() else set()
    return INDEX in names and all(name == INDEX or name.endswith(".webp") for name in names)


def load_photos(file: Path) -> tuple[AssetPhoto, ...]:
    """The photos of the asset in a file; () where it has none. ValueError where their index is corrupt; pictures are read when needed."""
    index = photos_folder(file) / INDEX
    if not index.is_file():
        return ()
    try:
        return tuple(_photo(index.parent, record) for record in json.loads(index.read_text(encoding="utf-8")))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        told = f"{type(error).__name__} {error}"
        raise ValueError(f"{index} is corrupt ({told}); remove {index.parent}, and the asset loads without photos") from error


def _photo(folder: Path, record: dict) -> AssetPhoto:
    name, pose = record["file"], torch.tensor(record["asset_from_cam"], dtype=torch.float64)
    if Path(name).name != name:
        raise ValueError(f"{name} leaves the folder")
    if pose.shape != (4, 4) or not pose.isfinite().all():
        raise ValueError(f"{name} has no pose of 4x4 numbers")
    fx, fy, cx, cy = (float(v) for v in record["pinhole"])
    if not (fx > 0 and fy > 0):
        raise ValueError(f"{name} has the focal lengths {fx:g}, {fy:g}")
    camera = Camera(Pinhole(fx, fy, cx, cy), int(record["width"]), int(record["height"]), pose, time_us=int(record["time_us"]))
    return AssetPhoto(camera, partial(_read, folder / name, camera.width, camera.height))


def _read(file: Path, width: int, height: int) -> np.ndarray:
    from scenes.pictures import opened

    fix = f"remove {file.parent}, and the asset loads without photos"
    with opened(file, str(file), fix) as picture:
        size = picture.size
        pixels = np.array(picture.convert("RGBA")) if size == (width, height) else None  # a header may claim any size
    if pixels is None:
        raise ValueError(f"{file} is {size[0]}x{size[1]} pixels, and {INDEX} says {width}x{height}; {fix}")
    return pixels
