"""Training: the autoencoder on single images, the prior on its latents, the objects' colours on objects, then, with all but
the prior frozen, the enhancer on rendered frames.

The enhancer's batches alternate: images without a past, and clips that the network walks through with its own earlier outputs as
their past, with any number of latents from 0 to K, so that it never sees a past better than the one it will make itself.
"""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch

from enhance.batch import Batch
from enhance.correcting.seam import usual_changes
from enhance.network.net import Net, NetConfig
from enhance.network.weights_file import BUILTIN, REPAIR_GAIN, WORTH, load_net, save_net
from enhance.pairs.shards import RENDERED, PairSet
from enhance.photos import Photos
from enhance.training.ahead import drawn, workers
from enhance.training.gain import repair_gain
from enhance.training.losses import PatchPerceptual
from enhance.training.run import FROZEN, FURTHER, STAGES, Run, TrainConfig, opened
from enhance.training.samples import Sampler
from enhance.training.stages import (
    autoencoder_step,
    draw_clips,
    draw_images,
    draw_right,
    enhancer_step,
    objects_step,
    prior_step,
    shade_step,
)
from scenes.atomic import made_folder
from scenes.names import unknown
from scenes.stops import Stops

USUAL = 1000
"""Objects by which it is told what changes are usual."""
TAKES = {"objects": "isp or clean pairs, or --photos", "shade": "shadow pairs", "enhancer": f"pairs of {', '.join(RENDERED)}"}
"""What a stage is trained on; all others take any right pictures."""


def train(
    pairs: str | Path | PairSet | None,
    out: str | Path,
    minutes: float | None = None,
    steps: int | None = None,
    seed: int = 0,
    resume: bool = False,
    progress: Callable[[float, str], None] | None = None,
    photos: tuple[str | Path, ...] = (),
    about: dict | None = None,
    config: TrainConfig | None = None,
    net: NetConfig | None = None,
    save_every: float = 60.0,
    start: str | Path | None = None,
    only: Sequence[str] | None = None,
    device: str | torch.device = "cpu",
    vgg: str | Path | None = None,
) -> Path:
    """Train on pairs and further photos; returns `out/enhancer.safetensors`.

    minutes, steps  the budget of all stages together: exactly one of the two. With steps a run repeats exactly, on a CPU.
    seed      of the first weights and of every sample drawn
    out       folder; holds checkpoint.pt too, from which `resume` continues, at most `save_every` seconds behind. Ctrl-C and SIGTERM let a
              step end and save first.
    photos    folders of images and videos, for the autoencoder, objects' colours and clean frames
    about     written into the weights' header, beside the data's attribution
    progress  called with the share done, 0..1, and a status line
    start     weights to train further, "builtin" or a file; their autoencoder is kept
    only      those of STAGES to train, which needs `start`; the parts of the others stay as they are
    device    where to train; a run may be resumed on another
    vgg       torchvision's vgg16 as a local file, whose features the perceptual loss compares; the autoencoder's own where None
    config    that of the checkpoint, or else `TrainConfig.of` the device, where None

    Raises FileExistsError where `out` holds a checkpoint and `resume` is off, or weights alone; ValueError where there is nothing to train
    a stage of `only` on (others are left out then), and where the checkpoint is of a training of something else.
    """
    out = Path(out)
    checkpoint, weights = out / "checkpoint.pt", out / "enhancer.safetensors"
    _check_budget(minutes, steps)
    _check_stages(only, start)
    _check_free(checkpoint, weights, resume)
    pair_set = PairSet(pairs) if isinstance(pairs, str | Path) else pairs
    if config is None:
        config = TrainConfig(**opened(checkpoint)["config"]) if checkpoint.exists() else TrainConfig.of(torch.device(device))
    sampler = Sampler(pair_set, Photos(tuple(photos)) if photos else None, seed, config.kinds)
    if sampler.rendered and sampler.longest < config.frames:
        print(
            f"the longest training clip has {sampler.longest} of {config.frames} frames, so no more past frames are used", file=sys.stderr
        )
    first = BUILTIN if start == "builtin" else start
    begun, origin = load_net(first) if first is not None else (None, None)
    if begun is None:
        torch.manual_seed(seed)
        begun = Net(net or NetConfig())
    stages = _stages(only, STAGES if start is None else FURTHER, sampler)
    weights_of = "nothing" if first is None else f"{Path(first).name} ({hashlib.sha256(Path(first).read_bytes()).hexdigest()[:8]})"
    told = {
        "stages": stages,
        "start": weights_of,
        "pairs": pair_set.digest() if pair_set else "",
        "photos": [Path(p).name for p in photos],
        "vgg": None if vgg is None else Path(vgg).name,
    }
    run = Run(config, begun, minutes, steps, seed, stages, device, told)
    if resume and checkpoint.exists():
        run.load(checkpoint)
    perceptual = PatchPerceptual(run.net.encoder, vgg).to(run.device)  # now, or a wrong file would be found after the other stages
    made_folder(out)
    report = _Reporter(run, progress)
    with Stops() as stops:
        _all_stages(run, sampler, perceptual, checkpoint, save_every, report, stops)
    run.save(checkpoint)
    header = {**(about or {}), **_made_of(pair_set, photos, origin), **_made_by(run)}
    save_net(run.average, weights, {**header, **_gain(run, pair_set, origin, report)})
    return weights


def _all_stages(
    run: Run, sampler: Sampler, perceptual: PatchPerceptual, checkpoint: Path, save_every: float, report: _Reporter, stops: Stops
) -> None:
    """Train the run's stages, one after the other; those that a checkpoint has passed are skipped."""
    go = partial(_stage, run, checkpoint, save_every, report, stops)
    go("autoencoder", partial(draw_images, run, sampler), partial(autoencoder_step, run))
    if "autoencoder" in run.stages:
        run.net.encoder.load_state_dict(run.autoencoder.encoder.state_dict())
    go("prior", partial(draw_right, run, sampler), partial(prior_step, run))
    go("objects", lambda step: sampler.objects(4 * step + 3, run.config.looked_at), partial(objects_step, run))
    if "objects" in run.stages and not run.passed("objects"):  # else the checkpoint has it
        run.save(checkpoint)  # what follows takes long, and a training that is killed in it must not have been in vain
        _learn_usual(run, sampler, report, stops)
    # its objects are read once and then cheap to draw: further processes would each have to read them
    go("shade", lambda step: sampler.grounds(step, 2 * run.config.looked_at), partial(shade_step, run), processes=0)
    now = run.net.state_dict()
    frozen = {k: v for k, v in now.items() if k.startswith(FROZEN)}
    run.average.load_state_dict(now if run.step["enhancer"] == 0 else run.average.state_dict() | frozen)
    for name, parameter in run.net.named_parameters():
        parameter.requires_grad_(not name.startswith(FROZEN))
    go("enhancer", partial(draw_clips, run, sampler), partial(enhancer_step, run, perceptual))


def _made_of(pairs: PairSet | None, photos: Sequence[str | Path], origin: dict | None) -> dict[str, object]:
    """What the weights' header says of the data they were trained on, and of the weights they go on from."""
    shards = pairs.of(split="train") if pairs else []
    data: dict[str, object] = {"attribution": sorted({str(s.meta["attribution"]) for s in shards if "attribution" in s.meta})}
    data |= {"clips": len(shards), "photos": [Path(p).name for p in photos]}
    return data if origin is None else data | {"further": origin}


def _made_by(run: Run) -> dict[str, object]:
    """What the weights' header says of the training."""
    return {"seed": run.seed, "steps": run.step, "minutes": {k: round(v / 60, 1) for k, v in run.seconds.items()}}


def _check_budget(minutes: float | None, steps: int | None) -> None:
    """ValueError where not just one of them is given, and positive."""
    budget = steps if minutes is None else minutes
    if budget is None or (minutes is not None and steps is not None):
        raise ValueError("give the training budget either as minutes or as steps")
    if not budget > 0:
        raise ValueError(f"the training budget must be positive, got {budget}")


def _check_stages(only: Sequence[str] | None, start: str | Path | None) -> None:
    """ValueError where `only` names no stage that can be trained alone, or there are no weights to start from."""
    for stage in only or ():
        if stage not in STAGES[1:]:
            raise ValueError(unknown("stage", stage, "what can be trained further", STAGES[1:]))
    if only and start is None:
        raise ValueError("training single stages needs weights to fine-tune; pass start, as builtin")


def _check_free(checkpoint: Path, weights: Path, resume: bool) -> None:
    """FileExistsError where a training is there and not resumed, or its weights alone; FileNotFoundError where there is none to resume."""
    if checkpoint.exists() and not resume:
        raise FileExistsError(f"{checkpoint.parent} holds a training already; go on with it by --resume, or choose another folder")
    if weights.exists() and not checkpoint.exists():
        raise FileExistsError(f"{weights} exists already, and no checkpoint of its training to go on from; choose another folder")
    if resume and not checkpoint.exists():
        raise FileNotFoundError(f"nothing to resume: {checkpoint} does not exist; run without --resume")


def _stages(only: Sequence[str] | None, usual: Sequence[str], sampler: Sampler) -> list[str]:
    """What is trained, each once: `only`, or of the `usual` stages those that there is something to train on; the others are said."""
    there = {  # asked only of what is to be trained: all shadow clips are read to find out
        "objects": lambda: sampler.has_objects,
        "shade": lambda: sampler.grounds(0, 1) is not None,
        "enhancer": lambda: bool(sampler.rendered),
    }
    lacking = [stage for stage in only or usual if stage in there and not there[stage]()]
    for stage in lacking:
        said = f"these pairs hold nothing to train {stage} on, which takes {TAKES[stage]}"
        if only:
            raise ValueError(f"{said}; make some with sidestep pairs --kinds, or leave {stage} out of --only")
        print(f"{said}: left out", file=sys.stderr)
    if len(lacking) == len(usual):
        raise ValueError(f"these pairs hold nothing to train any of {', '.join(usual)} on; make some with sidestep pairs")
    return [stage for stage in dict.fromkeys(only or usual) if stage not in lacking]


def _gain(run: Run, pairs: PairSet | None, origin: dict | None, report: _Reporter) -> dict[str, object]:
    """What repairing is worth, for the header: measured anew where the repairing was trained and something is held out to judge it by, else
    what was known of the weights begun with. Where there were none, training clips judge it."""
    # on clips that were trained on a network gains a whole dB by knowing the place
    rendered = [] if pairs is None else [s for s in pairs.of() if s.meta["kind"] in RENDERED]
    held_out = [s for s in rendered if s.meta["split"] == "held out"]
    trained = "enhancer" in run.stages
    if origin is not None and not (trained and held_out):
        if trained and REPAIR_GAIN in origin:
            print(f"no pairs are held out to measure repairs on; the network: {_works(origin[REPAIR_GAIN])}, as before", file=sys.stderr)
        return {REPAIR_GAIN: origin[REPAIR_GAIN]} if REPAIR_GAIN in origin else {}

    def looked_at(count: int, of: int) -> None:
        report("enhancer", f"measured the gain of repairs on {count} of {of} clips")

    gains = repair_gain(run.average, held_out or rendered, looked_at)
    if trained:
        where = "clips that are held out" if held_out else "the clips it was trained on, since none is held out"
        print(f"on {where} repairs gain {gains[0]:.2f} dB, and {gains[1]:.2f} beside photos; the network: {_works(gains)}", file=sys.stderr)
    return {REPAIR_GAIN: gains}


def _works(gains: Sequence[float]) -> str:
    """Where an enhancer of such weights repairs (`Enhancer`), for messages."""
    where = [name for name, gain in zip(("frames without photos", "frames with photos"), gains, strict=True) if gain >= WORTH]
    return f"it works on {' and '.join(where)}" if where else f"it stays off, as less than {WORTH} dB is not worth its time"


def _stage(
    run: Run,
    checkpoint: Path,
    save_every: float,
    report: _Reporter,
    stops: Stops,
    name: str,
    draw: Callable[[int], Batch | None],
    step: Callable[[Any, int], torch.Tensor],
    processes: int | None = None,
) -> None:
    batches = drawn(draw, run.step[name], run.device, workers(run.device) if processes is None else processes)
    saved = time.monotonic()
    while run.done(name) < 1:
        start = time.monotonic()
        run.set_rate(name)
        run.lost(name, step(next(batches), run.step[name]))
        run.seconds[name] += time.monotonic() - start
        report(name)
        if stops.asked or time.monotonic() - saved > save_every:
            run.save(checkpoint)
            saved = time.monotonic()
        stops.end()
    run.loss(name)


def _learn_usual(run: Run, sampler: Sampler, report: _Reporter, stops: Stops) -> None:
    """What changes objects usually need, for the seam (`enhance.correcting.seam`): the same whenever it is asked for, so that nothing of it
    is kept where it is broken off."""

    def drawn(count: int) -> None:
        report("objects", f"measured the usual changes on {count} of {USUAL} objects")
        stops.end()

    run.net.objects.usual.copy_(usual_changes(sampler.objects(3, USUAL, drawn)))
    report("objects")


class _Reporter:
    """Tells `progress` the smoothed loss, a few times a minute."""

    def __init__(self, run: Run, progress: Callable[[float, str], None] | None):
        self.run, self.progress, self.told = run, progress, 0.0

    def __call__(self, stage: str, said: str | None = None) -> None:
        """said: what is told in place of the loss."""
        if self.progress is None or (time.monotonic() - self.told < 5 and (said is not None or self.run.done(stage) < 1)):
            return
        self.told = time.monotonic()
        done = sum(self.run.share(name) * self.run.done(name) for name in STAGES)
        if said is None:
            loss = self.run.loss(stage)
            said = f"step {self.run.step[stage]}" + ("" if loss is None else f", loss {loss:.4f}")
        self.progress(done, f"{stage}: {said}")
