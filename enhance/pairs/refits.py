"""Reconstructions from less than was recorded: what they get wrong is the damage that the enhancer learns to undo.

sparse    some frames of every camera: views between are guessed
cycle     pictures rendered from a path beside the recorded one: the recorded views are then what is off the path
crossref  every other camera, by direction: each half of the rig is seen through the other half's reconstruction

Poses and exposures are those of the finished scene and are not corrected again, so that what is rendered lies where the photos lie
and is as bright: half a rig by itself would take its own first camera for the measure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch

from enhance.pairs.clips import scene_time
from recon.album import at_once
from recon.assemble import assemble
from recon.begin import begin
from recon.defaults import choose
from recon.fit.config import FitConfig
from recon.log import Log, LogCamera, Track
from recon.registration.corrected import as_corrected
from recon.views.frames import size_like
from render import render_frame
from render.progress import Progress
from render.references import References, Shot
from render.video import from_bytes, to_bytes, write_image
from scenes.camera import Camera, RigCamera
from scenes.files import load, save
from scenes.scene import Scene
from scenes.usd.metadata import is_scene

REFITS = ("sparse", "cycle", "crossref")
NEVER = 2.0
TENTH_US = 100_000
SHORT = FitConfig(steps=1500, budget=80_000, poses_from=NEVER)
SIZE = (480, 270)


@dataclass(frozen=True)
class Less:
    """How much less is fitted, and how."""

    every: int = 5
    """Of sparse: every how many tenths of a second a frame is kept, or frames of a slower camera; cars drive some 3 metres meanwhile."""
    aside: float = 1.5
    """Of cycle: metres to the left of the recorded path from which its pictures are rendered."""
    fit: FitConfig = SHORT

    @staticmethod
    def drawn(seed: int) -> Less:
        """By a seed; 0 gives the defaults. Others leave out more or less, and fit longer or shorter, with more or fewer splats: a network
        that has only seen one fit learns that fit's mistakes."""
        if seed == 0:
            return Less()
        rng = np.random.default_rng([seed, 11])
        aside = float(rng.choice([-1, 1]) * rng.uniform(0.7, 3.0))
        steps, budget = int(1500 * 2 ** rng.uniform(-0.7, 1.2)), int(80_000 * 2 ** rng.uniform(-1.0, 1.3))
        return Less(int(rng.choice([3, 4, 5, 7, 10])), aside, replace(SHORT, steps=steps, budget=budget, seed=seed))


@dataclass(frozen=True)
class Refit:
    """A scene made from less with the pictures that it was made from, and the cameras whose recorded views it is fair to render from it."""

    references: References
    cameras: tuple[str, ...]


def refits(
    kind: str,
    scene: Scene,
    log: Log,
    folder: str | Path,
    less: Less = Less(),  # noqa: B008 - frozen
    size: tuple[int, int] = SIZE,
    device: str = "cpu",
) -> list[Refit]:
    """The reconstructions of one of REFITS of a `scene` that was made from `log`; kept in `folder`, and read there where they are already.

    A fit takes some minutes; it runs on `device`, and there its scene is. Raises ValueError where the rig has too few cameras or frames.
    """
    log = as_reconstructed(log, scene)
    made = []
    for name, part, shown in _parts(kind, scene.to(device), log, Path(folder), less, size):
        path = Path(folder) / f"{name}_scene"
        if not is_scene(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            _fit(scene, part, path, less.fit, size, device)
        loaded = load(path)
        assert isinstance(loaded, Scene)
        made.append(Refit(References(shots_of(part, scene), loaded.to(device)), shown))
    return made


def exposed_as(scene: Scene, config: FitConfig) -> FitConfig:
    """A fit that gives frames exposures of their own only where the scene's have them: its cameras are what shows it."""
    return config if any(camera.gains is not None for camera in scene.rig.values()) else config.without("gains")


def shots_of(log: Log, scene: Scene) -> list[Shot]:
    """The pictures of a recording that `as_reconstructed` brought to the poses of a `scene`, with that scene's exposures, as if their rows
    had been read at once, by that scene's depth."""
    return [
        Shot(
            _exposed(camera.camera(i), scene.rig_camera(name)),
            partial(_read, scene, camera, i),
            camera.ego_mask,
        )
        for name, camera in log.cameras.items()
        for i, t in enumerate(camera.times_us)
    ]


def _exposed(camera: Camera, like: RigCamera) -> Camera:
    """A camera that takes its picture as one of a rig does at that time."""
    return replace(camera, exposure=like.exposure_at(camera.time_us), flat_field=like.flat_field)


def _read(scene: Scene, camera: LogCamera, index: int, width: int, height: int) -> np.ndarray:
    photo = from_bytes(camera.image(index, width, height))
    return to_bytes(at_once(scene, camera.camera(index, width, height), camera, photo))


def as_reconstructed(log: Log, scene: Scene) -> Log:
    """The recording at the poses and by the clocks that the scene's fit corrected, with the scene's cameras only."""
    log, cameras = as_corrected(log, scene.meta), {}
    for name in scene.rig:
        camera = log.camera(name)
        times = [scene_time(scene, name, int(t)) for t in camera.times_us]
        poses = torch.stack([scene.camera(name, t).world_from_cam for t in times])
        cameras[name] = replace(camera, times_us=torch.tensor(times), world_from_cam=poses)
    paths = {actor.track: actor.trajectory for actor in scene.actors}

    def corrected(track: Track) -> Track:
        path = paths.get(track.name)
        same = path is not None and torch.equal(path.times_us, torch.from_numpy(track.times_us))
        return replace(track, world_from_box=path.world_from_body) if same and path is not None else track

    return replace(log, ego=scene.ego, cameras=cameras, tracks=tuple(map(corrected, log.tracks)), front=())


def _parts(kind: str, scene: Scene, log: Log, folder: Path, less: Less, size: tuple[int, int]) -> list[tuple[str, Log, tuple[str, ...]]]:
    """Name, recording to fit, and cameras to render, of each reconstruction of a kind."""
    everyone = tuple(log.cameras)
    if kind == "sparse":
        few = {name: thinned(camera, less.every) for name, camera in log.cameras.items()}
        return [("sparse", replace(log, cameras=few), everyone)]
    if kind == "cycle":
        return [("cycle", rendered_aside(scene, log, folder / "cycle_views", less.aside, size), everyone)]
    halves = by_turns(log)
    if not all(halves):
        raise ValueError(f"crossref pairs need two cameras at least, and {log.name} has {', '.join(everyone)}; leave out that kind")
    return [(f"crossref_{i}", replace(log, cameras={n: log.cameras[n] for n in halves[i]}), halves[1 - i]) for i in (0, 1)]


def thinned(camera: LogCamera, every: int) -> LogCamera:
    """Every `every`th frame of a camera, where it takes no more than ten a second; as rarely of a faster one."""
    step = float(camera.times_us.diff().double().median()) if len(camera) > 1 else TENTH_US
    return camera.part(slice(None, None, every * max(1, round(TENTH_US / step))))


def by_turns(log: Log) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """The cameras in two halves: by the direction they look in, one for the one, the next for the other."""

    def bearing(name: str) -> float:
        forward = log.offsets(name)[0][:3, 2]
        return float(torch.atan2(forward[1], forward[0]))

    order = sorted(log.cameras, key=bearing)
    return tuple(order[::2]), tuple(order[1::2])


def rendered_aside(scene: Scene, log: Log, folder: Path, metres: float, size: tuple[int, int]) -> Log:
    """A recording of the scene from so many metres to the left, its pictures rendered into `folder`, the first camera's of a `size`."""
    ego = scene.ego.shifted(lateral=metres)
    first, cameras = next(iter(log.cameras.values())), {}
    with Progress("cycle views", total=sum(map(len, log.cameras.values()))) as steps:
        for name, camera in log.cameras.items():
            width, height = size_like(camera, first, size)
            views = [scene.camera(name, int(t), ego) for t in camera.times_us]
            files = tuple(folder / f"{name}_{i:04d}.png" for i in range(len(views)))
            for file, view in zip(files, views, strict=True):
                if not file.exists():
                    folder.mkdir(parents=True, exist_ok=True)
                    with torch.no_grad():
                        frame = render_frame(scene, view.resized(width, height))
                    assert frame.rgb is not None
                    write_image(file, frame.rgb.cpu())
                steps.step()
            lens = camera.lens.scaled(width / camera.width, height / camera.height)
            poses = torch.stack([v.world_from_cam for v in views])
            own = replace(camera, lens=lens, width=width, height=height, files=files, world_from_cam=poses)
            # renders take all rows at once, and show nothing of the car
            cameras[name] = replace(own, shutter="global", readout_us=0, ego_mask=np.zeros((1, 1), bool))
    return replace(log, ego=ego, cameras=cameras)


def _fit(scene: Scene, log: Log, path: Path, config: FitConfig, size: tuple[int, int], device: str) -> None:
    names, span = choose(log, list(log.cameras))
    known = config.without("exposures", "gains", "flat fields")
    start, fit = begin(log, names, span, size, known, held_out=0, device=device, exposed=scene.rig)
    with Progress(f"fit {path.name}", total=config.steps) as steps:
        while fit.step_count < config.steps:
            fit.step()
            steps.step(note=f"loss {fit.recent_loss:.4f}  {len(fit.splats)} splats")
    save(assemble(fit, start, log, {"name": f"{log.name}, {path.name}"}), path)
