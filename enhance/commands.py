"""`sidestep pairs`, `sidestep train` and `sidestep enhance`."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from shlex import quote
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from scenes import units
from scenes.alone import check_still, sole
from scenes.atomic import made_folder
from scenes.opening import UsageError, check_device, fresh
from scenes.options import FileOrNone, Flag, FolderOrNone, Names, Output, Overwrite, WeightsOrNone, written
from scenes.stops import resumed, stopped_saying


@dataclass
class Pairs:
    """Make training pairs for the enhancer from scenes and their recordings, and pairs to measure it by from photos."""

    scenes: Positional[Annotated[tuple[Path, ...], arg(metavar="SCENE")]]
    """Scene folders; of several, each gets a folder of its own in the output."""
    output: Output
    """Folder of the pairs; a run that was interrupted goes on where it stopped."""
    data: tuple[Path, ...] = ()
    """The recordings that the scenes were reconstructed from, in the same order."""
    kinds: Names = None
    """Kinds of degradation: sparse, cycle, crossref, underfit, isp (of instances, and as isp_frame of whole frames), relight, shadow,
    reinsert, clean. The first four need reconstructions from less data, which are fitted once, some minutes each."""
    cameras: Names = None
    """Cameras to use; the front camera's pairs are never trained on, where there are others."""
    skies: tuple[Path, ...] = ()
    """HDR environment maps (.hdr) for the kinds relight and shadow, beside synthetic ones."""
    relit: FolderOrNone = None
    """Folder to exchange photos with NVIDIA's DiffusionRenderer, which you run yourself (this command says how): it relights them for the
    kind relight, which uses the splats' normals otherwise."""
    databank: FolderOrNone = None
    """Databank whose assets the kind shadow inserts, beside those cut out of the scene."""
    photos: tuple[Path, ...] = ()
    """Folders of images, and videos, of places never trained on: pairs of single frames with a recoloured region, for evaluation."""
    size: Annotated[int, arg(metavar="PIXELS")] = 640
    """Width of the frames."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to fit and render."""
    seed: int = 0
    """Random seed: the same gives the same pairs; another holds out other frames, and fits longer or shorter, with more or fewer splats."""

    def run(self) -> None:
        from enhance.pairs.claims import claim_pairs
        from enhance.pairs.clips import PairConfig
        from enhance.pairs.inputs import check_cameras, check_kinds, open_reconstruction, open_recording
        from enhance.pairs.make import make_pairs
        from enhance.pairs.of_photos import check_names, make_photo_pairs
        from enhance.pairs.sources import prepare_sources
        from render.progress import Progress

        _some("--kinds", self.kinds)
        _some("--cameras", self.cameras)
        _check_seed(self.seed)
        if not (self.scenes or self.photos) or len(self.scenes) != len(self.data):
            counts = f"scenes: {len(self.scenes)}, recordings: {len(self.data)}"
            raise UsageError(f"give the recording of each scene with --data, in the same order; {counts}")
        names = [path.resolve().name for path in self.scenes]
        if twice := sorted({n for n in names if names.count(n) > 1}):
            raise UsageError(f"two scenes are called {twice[0]}, as the folders of their pairs would be; run the command once for each")
        config = PairConfig(width=self.size)
        check_kinds(self.kinds or ())
        check_names(self.photos)
        _check_there(*self.skies, *self.photos)
        if self.relit is not None and "relight" not in (self.kinds or ("relight",)):
            raise UsageError("--relit is for the kind relight, which --kinds does not name; add it, or leave out --relit")
        check_device(self.device)
        _with_shelf(self.output)
        with sole(self.output), stopped_saying(lambda: "the same command goes on from here"):
            drives = []
            for path, name, data in zip(self.scenes, names, self.data, strict=True):  # all now: a wrong one must not cost another's hours
                scene = open_reconstruction(path)
                log = open_recording(data, scene)
                out = self.output if len(self.scenes) == 1 else self.output / name
                drives.append((name, scene, log, check_cameras(scene, log, self.cameras), out))
            made_of = self._made_of()
            for name, scene, log, cameras, out in drives:
                claim_pairs(out, scene, log, self.seed, config, made_of)
                relit = None if self.relit is None else self.relit if len(self.scenes) == 1 else self.relit / name
                sources = prepare_sources(scene, log, out, self.kinds, self.skies, self.databank, self.device, self.seed, relit)
                with Progress(f"pairs {name}") as steps:

                    def say(done: int, total: int, name: str, steps: Progress = steps) -> None:
                        steps.total = total
                        steps.step(done - steps.done, name)

                    make_pairs(scene, log, out, sources.kinds, cameras, self.seed, say, sources, config, self.device, made_of)
            make_photo_pairs(self.photos, self.output / "photos", self.seed, self.size)
        print(f"wrote {self.output}")

    def _made_of(self) -> dict[str, str]:
        """What kinds are made of besides, of those that are asked for: a clip that is there is not made again of other things."""
        skies, bank = sorted(path.name for path in self.skies), str(self.databank and self.databank.resolve())
        lit = "DiffusionRenderer" if self.relit else "normals"
        of = {"relight": {"skies": str(skies), "light": lit}, "shadow": {"skies": str(skies), "databank": bank}}
        return {f"{what} of {k}": told for k, by in of.items() if self.kinds is None or k in self.kinds for what, told in by.items()}


def _check_seed(seed: int) -> None:
    if not 0 <= seed < 2**63:
        raise UsageError(f"--seed must be a whole number from 0 to 2^63 - 1, got {seed}")


def _check_there(*paths: Path) -> None:
    """FileNotFoundError where a path that will be wanted late is not there now."""
    for path in paths:
        if not path.exists():
            raise FileNotFoundError(f"{path} does not exist")


def _with_shelf(output: Path) -> None:
    """Make the folder that an output stands in, where it is missing."""
    if not output.parent.exists():
        made_folder(output.parent)


def _some(flag: str, names: tuple[str, ...] | None) -> None:
    """UsageError where names were asked for and none was given."""
    if names == ():
        raise UsageError(f"{flag} is empty; leave it out for all")


@dataclass
class Train:
    """Train the enhancer on pairs; Ctrl-C, then --resume, goes on where it stopped."""

    pairs: Positional[Annotated[tuple[Path, ...], arg(metavar="PAIRS")]]
    """Folders that sidestep pairs made."""
    output: Output
    """Folder of the training: checkpoint.pt and, at the end, enhancer.safetensors."""
    photos: tuple[Path, ...] = ()
    """Folders of images, and videos, as further clean training pictures."""
    time: Annotated[int, written(units.duration_us, "TIME", "7200s")] = 7_200_000_000
    """Training time, as 7200s."""
    seed: int = 0
    """Random seed of the initial weights and of the samples."""
    start: WeightsOrNone = None
    """Weights to fine-tune: builtin, or a file that sidestep train wrote; random ones by default."""
    only: Names = None
    """Parts of the network to fine-tune: prior, objects, shade, enhancer; the rest is frozen."""
    vgg: FileOrNone = None
    """File of torchvision's vgg16 weights for the perceptual loss; by default it compares the autoencoder's own features."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to train; the weights run on either."""
    resume: Flag = False
    """Resume from the folder's checkpoint."""

    def run(self) -> None:
        from enhance.pairs.shards import PairSet
        from enhance.training.train import train
        from render.progress import Progress

        if not self.pairs:
            raise UsageError("give at least one folder of pairs; sidestep pairs makes them")
        _some("--only", self.only)
        if self.only and self.start is None:
            raise UsageError("--only needs weights to fine-tune; give --start, as --start builtin")
        _check_seed(self.seed)
        _check_there(*self.photos)
        check_device(self.device)
        for folder in self.pairs:  # a training could not go on with more pairs than it was begun with
            # and a run for several scenes holds the folder above
            for part in (folder, folder.resolve().parent, *folder.glob("*")):
                check_still(part)
        _with_shelf(self.output)
        with sole(self.output), Progress("train", 1000) as steps:
            pairs = PairSet(*self.pairs)

            def say(share: float, line: str) -> None:
                if self.resume and not steps.done:
                    steps.resume(round(1000 * share))
                steps.step(round(1000 * share) - steps.done, line)

            with stopped_saying(partial(resumed, self.output / "checkpoint.pt")):
                weights = train(
                    pairs,
                    self.output,
                    minutes=self.time / 60e6,
                    seed=self.seed,
                    resume=self.resume,
                    progress=say,
                    photos=self.photos,
                    start=self.start,
                    only=self.only,
                    device=self.device,
                    vgg=self.vgg,
                )
        print(f"wrote {weights}; use it with --weights {quote(str(weights))}")


@dataclass
class Enhance:
    """Enhance any video, or a folder of pictures."""

    clip: Positional[Annotated[Path, arg(metavar="CLIP")]]
    """The video, or the folder of a clip's pictures."""
    output: Output
    """The enhanced video, as clean.mp4; of a folder of pictures, the folder of the enhanced ones."""
    weights: str = "builtin"
    """The enhancer's weights: builtin, a file that sidestep train wrote, or a public model's: Harmonizer, Fixer, Difix, Cosmos-Predict2."""
    instances: FolderOrNone = None
    """Masks of inserted objects, whose colours, shadows and noise are then corrected: a .png or .npy per frame, in which each object has a
    number or colour of its own and all else is 0. Those of render --outputs instance number recorded actors, too: set these to 0; out.json
    says which were inserted."""
    like: Annotated[Path | None, written(Path, "PHOTOS", "none")] = None
    """Reference photos of the same place: a folder, one photo, or a video. The whole clip is matched to their exposure, white balance,
    contrast and saturation, and loses noise and sharpening that they lack; differences as small as those among the photos stay. A scene's
    own photos are in its photos/CAMERA."""
    rendered: Flag = False
    """The video shows renders of splats: repair their artefacts. Without any of this, --instances and --like, the built-in weights change
    nothing."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Where to enhance."""
    overwrite: Overwrite = False
    """Replace an existing file or folder."""

    def run(self) -> None:
        fresh(self.output, self.overwrite)
        from enhance.clip import enhance_video, load_saying
        from render.progress import Progress

        check_device(self.device)
        with Progress(f"enhance {self.clip.name}") as steps:

            def say(done: int, total: int | None) -> None:
                steps.total = total
                steps.step(done - steps.done)

            enhancer = load_saying(self.weights, self.device)
            count, changed = enhance_video(self.clip, self.output, enhancer, say, self.rendered, self.instances, self.like)
        print(f"wrote {self.output}, {count} frame{'s' * (count != 1)}, {changed} of them changed")
