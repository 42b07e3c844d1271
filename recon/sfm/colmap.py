"""pycolmap, the settings that every use of it shares, and the only import of it. Seeds and thread counts are fixed, so that the same
pictures give the same result."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

import numpy as np

SEED = 0
"""Of all of COLMAP's random draws: with its default one set of photos gets another lens and other poses each time."""

MISSING = (
    "COLMAP models, photos and drives without lidar need pycolmap, which is not installed; get it with: pip install 'sidestep[colmap]'"
)


def pycolmap():
    """The module, with its random generator seeded. ValueError with the fix where it is not installed."""
    try:
        import zlib  # noqa: F401  # first: pycolmap 4.2 brings one of its own, and the interpreter's, loaded after it, crashes

        stop = signal.getsignal(signal.SIGTERM)
        import pycolmap as module

        if stop is not None and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, stop)  # its own, which comes with it, writes a crash report, and nothing is tidied up
    except ModuleNotFoundError:
        raise ValueError(MISSING) from None
    module.logging.minloglevel = module.logging.Level.FATAL.value
    module.set_random_seed(SEED)
    return module


def mapping_options(colmap):
    """Options of incremental mapping. One thread: several try initial pairs and add up in any order, and lenses come out 5 % apart."""
    options = colmap.IncrementalPipelineOptions()
    options.random_seed, options.num_threads = SEED, 1
    return options


def verification_options(colmap):
    """Options by which matches are verified against two-view geometry."""
    options = colmap.TwoViewGeometryOptions()
    options.ransac.random_seed = SEED
    return options


def extract_features(colmap, database: Path, pictures: Path, names: list[str], reader, extraction) -> None:
    """Write the features of the named files in the folder `pictures` into a database. The pictures are entered first, in the order of
    their names: threads would enter them as they finish, and results depend on the order."""
    single = colmap.CameraMode.SINGLE
    colmap.Database.open(database).close()
    colmap.import_images(database, pictures, single, names, reader)
    colmap.extract_features(database, pictures, names, single, reader, extraction, device=colmap.Device.cpu)


def visible_points(image, place: dict[int, int]) -> np.ndarray:
    """The points that a registered picture shows, int64 `[P]`, rising: COLMAP's ids mapped by `place`, others left out."""
    points = [place[p.point3D_id] for p in image.get_observation_points2D() if p.point3D_id in place]
    return np.unique(np.array(points, dtype=np.int64))
