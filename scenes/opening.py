"""What several sub-commands do: refuse what stands, open a scene."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from scenes.atomic import need_folder

if TYPE_CHECKING:
    import torch

    from scenes import Asset, Gaussians, Scene


class UsageError(Exception):
    """The command line asks for something that makes no sense; exit 2."""


def fresh(path: Path, overwrite: bool) -> Path:
    """A path that may be written; FileExistsError where something stands there and -w was not given, FileNotFoundError and PermissionError
    where its folder is not there or takes no files."""
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path} exists; give -w to replace it, or another name")
    need_folder(path)
    return path


def scene_folder(path: str | Path) -> Path:
    """The folder of a scene that is named by it, or by its scene.usda."""
    path = Path(path)
    return path.parent if path.name == "scene.usda" else path


def check_device(device: str | torch.device) -> None:
    """ValueError where there is no such device, or the machine has none."""
    import torch

    try:
        known = torch.device(device)
    except (RuntimeError, TypeError):
        known = None
    if known is None or known.type not in ("cpu", "cuda"):
        raise ValueError(f'device must be "cpu" or "cuda", of several GPUs one as "cuda:1"; got {device!r}')
    if known.type == "cpu":
        return
    if not torch.cuda.is_available():
        raise ValueError("this machine has no CUDA device that torch can use; leave --device cuda out")
    if known.index is not None and known.index >= (count := torch.cuda.device_count()):
        raise ValueError(f"this machine has {count} CUDA device{'s' * (count != 1)}, from cuda:0; got {known}")


def open_scene(path: Path, drop_invalid: bool = False) -> tuple[Scene, list[str]]:
    """The scene of a folder, and what was dropped from it. ValueError where it is something else, empty, or not finite."""
    from scenes import Scene

    thing, warnings = _open(path, drop_invalid)
    if not isinstance(thing, Scene):
        raise ValueError(f"{path} holds {_kind(thing)}, not a scene; give a folder that sidestep recon wrote")
    if not len(thing.background.gaussians) and not thing.actors:
        raise ValueError(f"{path} is empty: it has no splats and no actors; reconstruct it again with sidestep recon")
    return replace(thing, meta={**thing.meta, "path": str(path)}), warnings  # errors name the folder that the user named


def open_view(path: Path, drop_invalid: bool = False, up: str | None = None) -> tuple[Scene, list[str]]:
    """As `open_scene`; of splats or an asset a scene with the camera `orbit`, which circles them. up: the axis of the file that points up,
    if None z, or what the format or the file says."""
    from scenes.files import kind_of
    from scenes.formats.axis import axis_warning, loaded_axis
    from scenes.formats.trained import model_of
    from scenes.orbit import around

    if kind_of(path) not in ("asset", "splats"):
        if up is not None:
            raise UsageError(f"--up is for files of splats; {path} is a scene, whose z is up")
        return open_scene(path, drop_invalid)
    thing, warnings = open_splats(path, drop_invalid, up)
    warnings += axis_warning(path) if up is None else []
    return around(thing, str(path), loaded_axis(path, up) if up else "z", model_of(path)), warnings


def open_splats(path: Path, drop_invalid: bool = False, up: str | None = None) -> tuple[Asset | Gaussians, list[str]]:
    """The splats or asset of a file, and what was dropped. ValueError where it is a scene or not finite; UsageError where an asset is said
    to have another axis that points `up` than its own."""
    from scenes import Asset, Scene

    thing, warnings = _open(path, drop_invalid)
    if isinstance(thing, Scene):
        raise ValueError(f"{path} is a scene of many files; give one of them, as {path / 'background.usdc'}")
    if up is not None and isinstance(thing, Asset):
        raise UsageError(f"--up is for files of splats; {path} is an asset, whose z is up")
    return thing, warnings


def _open(path: Path, drop_invalid: bool) -> tuple[Asset | Gaussians | Scene, list[str]]:
    from scenes.files import Dropping, read

    dropping = Dropping()
    thing = read(path, dropping if drop_invalid else _refuse)
    return thing, [dropped(dropping.count)] if dropping.count else []


def dropped(count: int) -> str:
    return f"dropped {count} splat{'s' * (count != 1)} with values that are not finite"


def _refuse(gaussians: Gaussians, where: str) -> Gaussians:
    try:
        return gaussians.checked(where)
    except ValueError as error:
        raise ValueError(f"{error}; give --drop-invalid to leave them out") from error


def _kind(thing: Asset | Gaussians | Scene) -> str:
    return {"Asset": "an asset", "Gaussians": "splats"}[type(thing).__name__]
