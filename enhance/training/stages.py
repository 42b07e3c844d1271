"""What each stage of the training does in a step: what it draws, and the loss that it takes a step down."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
import torch
from torch.nn import functional as F

from enhance.correcting.objects import Objects, changed
from enhance.correcting.shade import optical_depth, shaded
from enhance.network.net import Net, photos_of
from enhance.network.past import Past
from enhance.network.precision import autocast
from enhance.training.losses import PatchPerceptual, flicker, pixel_loss
from enhance.training.prior import flow_matching_loss
from enhance.training.run import Run, TrainConfig
from enhance.training.samples import Images, Sample, Sampler
from enhance.training.shade_samples import Grounds

NEAR_ENOUGH = 3e-4
"""Squared error of an object's colours below which getting nearer counts for little: 35 dB."""
SHADE_NEAR_ENOUGH = 1e-3
"""The same of the ground by an object: about what a missing shadow costs. With less, the fear to shade what is right drowns all else."""
CROPS = (1.0, 1.0, 1.5, 2.0)
"""Sides of the crops that batches are made of, against the smallest: attention must work on small pictures and on large ones."""


def draw_images(run: Run, sampler: Sampler, step: int) -> Images:
    return sampler.images(2 * step, 2 * run.config.images, max(32, run.config.crop * 2 // 3 // 16 * 16))


def autoencoder_step(run: Run, batch: Images, step: int) -> torch.Tensor:
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


def draw_right(run: Run, sampler: Sampler, step: int) -> Images:
    return sampler.right(5 * step + 4, run.config.images, run.config.crop)


def prior_step(run: Run, batch: Images, step: int) -> torch.Tensor:
    right = batch.rgb
    with torch.no_grad(), autocast(right.device):
        latents = run.net.encoder(right.contiguous(memory_format=torch.channels_last))
    generator = torch.Generator(right.device).manual_seed(run.seed * 1_000_003 + step)
    with autocast(right.device):
        loss = flow_matching_loss(run.net, run.time, latents.float(), generator)
    return _update(run, "prior", [loss])


def objects_step(run: Run, batch: Objects, step: int) -> torch.Tensor:
    with autocast(batch.given.device):
        coefficients = run.net.objects(batch.evidence)
    error = (batch.given + changed(batch.given, batch.height, coefficients) - batch.target).square().mean((1, 2))
    return _update(run, "objects", [torch.log(error + NEAR_ENOUGH).mean()])


def shade_step(run: Run, batch: Grounds, step: int) -> torch.Tensor:
    dark = shaded(batch.given, optical_depth(batch.places, run.net.objects.shade(batch.read)))
    error = (dark - batch.target).square().mean((1, 2))
    return _update(run, "shade", [torch.log(error + SHADE_NEAR_ENOUGH).mean()])


def _crops(run: Run, step: int) -> tuple[np.random.Generator, float]:
    """What is drawn for a step beside its sample, and first of it how large its crops are."""
    rng = np.random.default_rng([run.seed, 7, step])
    return rng, float(rng.choice(CROPS))


def draw_clips(run: Run, sampler: Sampler, step: int) -> Sample:
    c = run.config
    temporal = step % c.temporal_every == 1 and c.frames > 1
    _, scale = _crops(run, step)
    count = max(1, round((c.clips if temporal else c.images) / scale**2))
    return sampler.batch(2 * step + 1, count, min(c.frames, sampler.longest) if temporal else 1, round(c.crop * scale / 16) * 16)


def enhancer_step(run: Run, perceptual: PatchPerceptual, sample: Sample, step: int) -> torch.Tensor:
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
