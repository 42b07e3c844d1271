"""`sidestep pairs`, `sidestep train` and `sidestep enhance`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from tyro.conf import Positional, arg

from scenes import units
from scenes.opening import UsageError, fresh
from scenes.options import Flag, Names, Output, Overwrite, ScenePath, written


@dataclass
class Pairs:
    """Make training pairs for the enhancer from a scene and its recording."""

    scene: ScenePath
    """Scene folder."""
    data: Path
    """The recording that the scene was reconstructed from."""
    output: Output
    """Folder of the pairs; a run that was interrupted goes on where it stopped."""
    cameras: Names = None
    """Cameras to use; the front camera's pairs are never trained on."""
    seed: int = 0
    """Same seed, same pairs."""

    def run(self) -> None:
        from enhance.pairs import make_pairs
        from recon import open_log, stopped_early
        from render.progress import Progress
        from scenes import load

        log, scene = open_log(self.data), load(self.scene)
        early = stopped_early(log, self.output / "early", [name for name in log.cameras if name in scene.rig])
        with Progress("pairs") as steps:

            def say(done: int, total: int, name: str) -> None:
                steps.total = total
                steps.step(done - steps.done, name)

            make_pairs(scene, log, self.output, cameras=self.cameras, seed=self.seed, progress=say, unfinished=early)
        print(f"wrote {self.output}")


@dataclass
class Train:
    """Train the enhancer on pairs; Ctrl-C, then --resume, goes on where it stopped."""

    pairs: Positional[Annotated[tuple[Path, ...], arg(metavar="PAIRS")]]
    """Folders that sidestep pairs made."""
    output: Output
    """Folder of the training: checkpoint.pt and, at the end, enhancer.safetensors."""
    photos: tuple[Path, ...] = ()
    """Folders of images, and videos: further clean pictures."""
    time: Annotated[int, written(units.duration_us, "TIME", "7200s")] = 7_200_000_000
    """How long to train, as 7200s."""
    seed: int = 0
    """Seed of the first weights and of every sample."""
    resume: Flag = False
    """Go on from the folder's checkpoint."""

    def run(self) -> None:
        from enhance.shards import PairSet
        from enhance.train import train
        from render.progress import Progress

        if not self.pairs:
            raise UsageError("give at least one folder of pairs; sidestep pairs makes them")
        pairs = PairSet(*self.pairs)
        with Progress("train", 1000) as steps:
            say = lambda share, line: steps.step(round(1000 * share) - steps.done, line)  # noqa: E731
            try:
                weights = train(
                    pairs, self.output, minutes=self.time / 60e6, seed=self.seed, resume=self.resume, progress=say, photos=self.photos
                )
            except KeyboardInterrupt:
                raise KeyboardInterrupt("interrupted; the same command with --resume goes on from here") from None
        print(f"wrote {weights}; use it with --weights {weights}")


@dataclass
class Enhance:
    """Enhance any video."""

    clip: Positional[Annotated[Path, arg(metavar="CLIP")]]
    """The video."""
    output: Output
    """The enhanced video, as clean.mp4."""
    weights: str = "builtin"
    """The enhancer's weights: builtin, or a file that sidestep train wrote."""
    overwrite: Overwrite = False
    """Replace an existing file."""

    def run(self) -> None:
        fresh(self.output, self.overwrite)
        from enhance import Enhancer
        from enhance.clip import enhance_video
        from render.progress import Progress
        from render.video import read_video

        with Progress(f"enhance {self.clip.name}", read_video(self.clip).count) as steps:
            count = enhance_video(self.clip, self.output, Enhancer.load(self.weights), lambda done, total: steps.step())
        print(f"wrote {self.output}, {count} frames")
