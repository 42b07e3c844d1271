"""Training: the autoencoder on single images, the prior on its latents, the objects' colours on objects, then, with all but
the prior frozen, the enhancer on rendered frames.

The enhancer's batches alternate: images without a past, and clips that the network walks through with its own earlier outputs as
their past, with any number of latents from 0 to K, so that it never sees a past better than the one it will make itself.
"""

from __future__ import annotations

import hashlib
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch.nn import functional as F

from enhance.batch import Batch
from enhance.correcting.objects import Objects, changed
from enhance.correcting.seam import usual_changes
from enhance.correcting.shade import optical_depth, shaded
from enhance.network.net import Net, NetConfig, photos_of
from enhance.network.past import Past
from enhance.network.precision import autocast
from enhance.network.weights_file import BUILTIN, REPAIR_GAIN, WORTH, load_net, save_net
from enhance.pairs.shards import RENDERED, PairSet
from enhance.photos import Photos
from enhance.training.ahead import drawn, workers
from enhance.training.gain import repair_gain
from enhance.training.losses import PatchPerceptual, flicker, pixel_loss
from enhance.training.prior import flow_matching_loss
from enhance.training.run import FROZEN, FURTHER, STAGES, Run, TrainConfig, opened
from enhance.training.samples import Images, Sample, Sampler
from enhance.training.shade_samples import Grounds
from scenes.atomic import made_folder
from scenes.names import unknown
from scenes.stops import Stops

NEAR_ENOUGH = 3e-4
"""Squared error of an object's colours below which getting nearer counts for little: 35 dB."""
USUAL = 1000
"""Objects by which it is told what changes are usual."""
TAKES = {"objects": "isp or clean pairs, or --photos", "shade": "shadow pairs", "enhancer": f"pairs of {', '.join(RENDERED)}"}
"""What a stage is trained on; all others take any right pictures."""
SHADE_NEAR_ENOUGH = 1e-3
"""The same of the ground by an object: about what a missing shadow costs. With less, the fear to shade what is right drowns all else."""


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
    progress  called with the share done, 0..1, and a line of words
    start     weights to train further, "builtin" or a file; their autoencoder is kept
    only      of STAGES those to train, which takes weights to start from; the others' parts stay as they are
    device    where to train; a run may be resumed on another
    vgg       torchvision's vgg16 as a local file, whose features the perceptual loss compares; the autoencoder's own where None
    config    that of the checkpoint, or else `TrainConfig.of` the device, where None

    Raises FileExistsError where `out` holds a checkpoint and `resume` is off, or weights alone; ValueError where there is nothing to train
    a stage of `only` on (others are left out then), and where the checkpoint is of a training of something else.
    """
    budget = steps if minutes is None else minutes
    if budget is None or (minutes is not None and steps is not None):
        raise ValueError("give the training budget either as minutes or as steps")
    if not budget > 0:
        raise ValueError(f"the training budget must be positive, got {budget}")
    for stage in only or ():
        if stage not in STAGES[1:]:
            raise ValueError(unknown("stage", stage, "what can be trained further", STAGES[1:]))
    if only and start is None:
        raise ValueError("a stage alone takes weights to start from; pass start, as builtin")
    out = Path(out)
    checkpoint, weights = out / "checkpoint.pt", out / "enhancer.safetensors"
    if checkpoint.exists() and not resume:
        raise FileExistsError(f"{out} holds a training already; go on with it by --resume, or choose another folder")
    if weights.exists() and not checkpoint.exists():
        raise FileExistsError(f"{weights} exists already, and no checkpoint of its training to go on from; choose another folder")
    if resume and not checkpoint.exists():
        raise FileNotFoundError(f"nothing to resume: {checkpoint} does not exist; run without --resume")
    pair_set = PairSet(pairs) if isinstance(pairs, str | Path) else pairs
    if config is None:
        config = TrainConfig(**opened(checkpoint)["config"]) if checkpoint.exists() else TrainConfig.of(torch.device(device))
    sampler = Sampler(pair_set, Photos(tuple(photos)) if photos else None, seed, config.kinds)
    if sampler.rendered and sampler.longest < config.frames:
        print(
            f"the longest training clip has {sampler.longest} of {config.frames} frames: that is as far as is looked back", file=sys.stderr
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
        go = partial(_stage, run, checkpoint, save_every, report, stops)
        go("autoencoder", partial(_images, run, sampler), partial(_autoencoder_step, run))
        if "autoencoder" in run.stages:
            run.net.encoder.load_state_dict(run.autoencoder.encoder.state_dict())
        go("prior", partial(_right, run, sampler), partial(_prior_step, run))
        go("objects", lambda step: sampler.objects(4 * step + 3, config.looked_at), partial(_objects_step, run))
        if "objects" in run.stages and not run.passed("objects"):  # else the checkpoint has it
            run.save(checkpoint)  # what follows takes long, and a training that is killed in it must not have been in vain
            _learn_usual(run, sampler, report, stops)
        # its objects are read once and then cheap to draw: further processes would each have to read them
        go("shade", lambda step: sampler.grounds(step, 2 * config.looked_at), partial(_shade_step, run), processes=0)
        now = run.net.state_dict()
        frozen = {k: v for k, v in now.items() if k.startswith(FROZEN)}
        run.average.load_state_dict(now if run.step["enhancer"] == 0 else run.average.state_dict() | frozen)
        for name, parameter in run.net.named_parameters():
            parameter.requires_grad_(not name.startswith(FROZEN))
        go("enhancer", partial(_clips, run, sampler), partial(_enhancer_step, run, perceptual))
    run.save(checkpoint)
    shards = pair_set.of(split="train") if pair_set else []
    data: dict[str, object] = {"attribution": sorted({str(s.meta["attribution"]) for s in shards if "attribution" in s.meta})}
    data |= {"clips": len(shards), "photos": [Path(p).name for p in photos]}
    data |= {"further": origin} if origin is not None else {}
    made = {**data, "seed": seed, "steps": run.step, "minutes": {k: round(v / 60, 1) for k, v in run.seconds.items()}}
    save_net(run.average, weights, {**(about or {}), **made, **_gain(run, pair_set, origin, report)})
    return weights


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
            print(
                f"nothing of these pairs is held out to judge the repairing by: {_works(origin[REPAIR_GAIN])}, as before", file=sys.stderr
            )
        return {REPAIR_GAIN: origin[REPAIR_GAIN]} if REPAIR_GAIN in origin else {}

    def looked_at(count: int, of: int) -> None:
        report("enhancer", f"looked at {count} of {of} clips for what the repairing gains")

    gains = repair_gain(run.average, held_out or rendered, looked_at)
    if trained:
        where = "clips that are held out" if held_out else "the clips it was trained on, since none is held out"
        print(f"on {where} the repairing gains {gains[0]:.2f} dB, and {gains[1]:.2f} beside photos: {_works(gains)}", file=sys.stderr)
    return {REPAIR_GAIN: gains}


def _works(gains: Sequence[float]) -> str:
    """Where an enhancer of such weights repairs (`Enhancer`), for messages."""
    where = [name for name, gain in zip(("frames without photos", "frames with photos"), gains, strict=True) if gain >= WORTH]
    return f"it works on {' and '.join(where)}" if where else f"it rests, as less than {WORTH} dB are not worth its time"


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
        report("objects", f"looked at {count} of {USUAL} objects for what changes are usual")
        stops.end()

    run.net.objects.usual.copy_(usual_changes(sampler.objects(3, USUAL, drawn)))
    report("objects")


def _images(run: Run, sampler: Sampler, step: int) -> Images:
    return sampler.images(2 * step, 2 * run.config.images, max(32, run.config.crop * 2 // 3 // 16 * 16))


def _autoencoder_step(run: Run, batch: Images, step: int) -> torch.Tensor:
    x = batch.rgb.contiguous(memory_format=torch.channels_last)
    torch.manual_seed(run.seed * 1_000_003 + step)
    with autocast(x.device):
        y, latent = run.autoencoder(x, noise=0.05)
    loss = autoencoder_loss(y.float(), x, latent.float())
    return _update(run, "autoencoder", [loss])


def autoencoder_loss(y: torch.Tensor, x: torch.Tensor, latent: torch.Tensor) -> torch.Tensor:
    """Absolute error of the image, of its 4 x 4 means and of its gradients, and latents pulled to zero mean and unit variance."""
    d = y - x
    slopes = (d[..., 1:] - d[..., :-1]).abs().mean() + (d[..., 1:, :] - d[..., :-1, :]).abs().mean()
    spread = latent.mean((0, 2, 3)).square().mean() + (latent.var((0, 2, 3)) - 1).square().mean()
    return d.abs().mean() + 0.5 * F.avg_pool2d(d, 4).abs().mean() + 0.5 * slopes + 1e-3 * spread


def _right(run: Run, sampler: Sampler, step: int) -> Images:
    return sampler.right(5 * step + 4, run.config.images, run.config.crop)


def _prior_step(run: Run, batch: Images, step: int) -> torch.Tensor:
    right = batch.rgb
    with torch.no_grad(), autocast(right.device):
        latents = run.net.encoder(right.contiguous(memory_format=torch.channels_last))
    generator = torch.Generator(right.device).manual_seed(run.seed * 1_000_003 + step)
    with autocast(right.device):
        loss = flow_matching_loss(run.net, run.time, latents.float(), generator)
    return _update(run, "prior", [loss])


def _objects_step(run: Run, batch: Objects, step: int) -> torch.Tensor:
    with autocast(batch.given.device):
        coefficients = run.net.objects(batch.evidence)
    error = (batch.given + changed(batch.given, batch.height, coefficients) - batch.target).square().mean((1, 2))
    return _update(run, "objects", [torch.log(error + NEAR_ENOUGH).mean()])


def _shade_step(run: Run, batch: Grounds, step: int) -> torch.Tensor:
    dark = shaded(batch.given, optical_depth(batch.places, run.net.objects.shade(batch.read)))
    error = (dark - batch.target).square().mean((1, 2))
    return _update(run, "shade", [torch.log(error + SHADE_NEAR_ENOUGH).mean()])


CROPS = (1.0, 1.0, 1.5, 2.0)
"""Sides of the crops that batches are made of, against the smallest: attention must work on small pictures and on large ones."""


def _crops(run: Run, step: int) -> tuple[np.random.Generator, float]:
    """What is drawn for a step beside its sample, and first of it how large its crops are."""
    rng = np.random.default_rng([run.seed, 7, step])
    return rng, float(rng.choice(CROPS))


def _clips(run: Run, sampler: Sampler, step: int) -> Sample:
    c = run.config
    temporal = step % c.temporal_every == 1 and c.frames > 1
    _, scale = _crops(run, step)
    count = max(1, round((c.clips if temporal else c.images) / scale**2))
    return sampler.batch(2 * step + 1, count, min(c.frames, sampler.longest) if temporal else 1, round(c.crop * scale / 16) * 16)


def _enhancer_step(run: Run, perceptual: PatchPerceptual, sample: Sample, step: int) -> torch.Tensor:
    rng, _ = _crops(run, step)
    total = _update(run, "enhancer", rollout_losses(run.net, sample, perceptual, run.config, rng))
    decay = min(0.999, (1 + step) / (10 + step))
    with torch.no_grad():
        torch._foreach_lerp_(list(run.average.parameters()), list(run.net.parameters()), 1 - decay)
    return total


def rollout_losses(net: Net, sample: Sample, perceptual: PatchPerceptual, c: TrainConfig, rng: np.random.Generator):
    """Walk through the clips; yields each frame's loss when that frame is done, so that its graph can be freed at once.

    The past has a random number of latents and is, in one clip of four, left unmoved, as in a plain video without flow.
    """
    frames = sample.input.shape[1]
    longest = int(rng.integers(0, net.config.history + 1)) if frames > 1 else 0
    moved = rng.random() < 0.75
    past: Past | None = None
    for t in range(frames):
        given, target = sample.input[:, t], sample.target[:, t]
        previous = past.rgb if past is not None else None
        if past is not None:
            past = replace(past, latents=past.latents[:, :longest], valid=past.valid[:, :longest])
            past = past.moved(sample.flow[:, t]) if moved else past
        with autocast(given.device):
            out = net(given, sample.mask[:, t], past, photos_of(sample.reference[:, t], sample.trust[:, t]))
            with torch.no_grad():
                wanted = net.encoder(target.contiguous(memory_format=torch.channels_last))
            seen = perceptual(out.rgb, target, rng) if c.perceptual else 0.0
        loss = pixel_loss(out.rgb, target, c.logarithm) + c.perceptual * seen + c.latent * (out.latent - wanted.float()).abs().mean()
        if previous is not None:
            before = sample.target[:, t - 1]
            loss = loss + c.temporal * flicker(out.rgb, previous, target, before, sample.flow[:, t], sample.visible[:, t])
        past = out.past
        yield loss / frames


def _update(run: Run, stage: str, losses: Iterable[torch.Tensor]) -> torch.Tensor:
    optimiser, total = run.optimiser[stage], torch.zeros((), device=run.device)
    optimiser.zero_grad()
    for loss in losses:
        loss.backward()
        total += loss.detach()
    torch.nn.utils.clip_grad_norm_(optimiser.param_groups[0]["params"], 1.0)
    optimiser.step()
    return total


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
