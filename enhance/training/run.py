"""A training under way: its settings, how far each stage is, and what must be kept to go on from there."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from enhance.network.autoencoder import Autoencoder
from enhance.network.net import Net
from enhance.network.precision import channels_last
from enhance.pairs.shards import KINDS
from enhance.training.prior import Time
from scenes.state import load_state, save_state

STAGES = ("autoencoder", "prior", "objects", "shade", "enhancer")
FURTHER = STAGES[2:]
"""What trained weights are trained further by: a prior would undo what their transformer has learnt since."""
RATES = {"autoencoder": 2.5, "objects": 2.0, "shade": 7.5}  # of the highest rate
FROZEN = ("encoder.", "objects.")  # parts of the network that the last stage leaves as they are


@dataclass(frozen=True)
class TrainConfig:
    """How to train."""

    autoencoder: float = 0.07
    """Share of the budget for the autoencoder."""
    prior: float = 0.04
    """Share of the budget for the transformer's prior."""
    objects: float = 0.25
    """Share of the budget for objects' colours."""
    shade: float = 0.01
    """Share of the budget for objects' missing shadows."""
    crop: int = 160
    """Side of the smallest training crops in pixels, a multiple of 16."""
    images: int = 8
    """Smallest crops in an image batch; larger ones are fewer."""
    clips: int = 3
    """Clips of smallest crops in a temporal batch."""
    looked_at: int = 32
    """Objects in a batch of objects' colours, and of missing shadows."""
    frames: int = 5
    """Frames of a training clip: one, and as many as the network looks back to."""
    temporal_every: int = 4
    """Every how many steps a temporal batch comes; the others are images."""
    rate: float = 8e-4
    """Highest learning rate; half of it where trained weights are trained further."""
    latent: float = 0.1
    """Weight of the distance of the enhanced latent to the target's."""
    logarithm: float = 0.02
    """Weight of the logarithm of the squared error beside the absolute one."""
    perceptual: float = 0.01
    """Weight of the perceptual distance on a random patch."""
    temporal: float = 0.3
    """Weight of flicker that the target has not, in temporal batches."""
    kinds: tuple[str, ...] = KINDS
    """Kinds of damage to learn from, of those that the pairs hold."""

    @classmethod
    def of(cls, device: torch.device) -> TrainConfig:
        """What suits a device. A GPU's step is thousands of small kernels, whose begin costs more than eight of the CPU's batches; eight
        are about what 15 cores draw meanwhile. Shadows, whose objects one core reads first, need seconds before they begin. Crops stay:
        twice the smallest is all that frames of 360 rows hold."""
        return cls() if device.type == "cpu" else cls(images=64, clips=16, looked_at=128, shade=0.03, rate=1.2e-3)

    def __post_init__(self):
        if self.temporal_every < 2:
            raise ValueError(f"temporal_every must be at least 2, got {self.temporal_every}")
        if self.crop % 16 or self.crop < 32:
            raise ValueError(f"crop must be a multiple of 16 from 32, got {self.crop}")


class Run:
    """All that a resumed training needs: networks, optimisers, averaged weights, and how far each stage is."""

    def __init__(
        self,
        config: TrainConfig,
        net: Net,
        minutes: float | None,
        steps: int | None,
        seed: int,
        stages: Sequence[str],
        device: str | torch.device = "cpu",
        told: dict | None = None,
    ):
        """told: what it is trained on and from, json-like by name; a checkpoint of a training that was told otherwise is refused."""
        torch.manual_seed(seed)
        self.told = told or {}
        self.device = torch.device(device)
        self.config, self.minutes, self.steps, self.seed, self.stages = config, minutes, steps, seed, stages
        self.autoencoder = channels_last(Autoencoder().to(self.device))
        self.average = channels_last(Net(net.config).to(self.device))
        self.average.load_state_dict(net.state_dict())
        self.time = Time(net.config.width).to(self.device)
        self.net = channels_last(net.to(self.device))
        self.step = dict.fromkeys(STAGES, 0)
        self.seconds = dict.fromkeys(STAGES, 0.0)
        self._loss: dict[str, torch.Tensor] = {}
        self.optimiser = {
            "autoencoder": torch.optim.AdamW(self.autoencoder.parameters(), betas=(0.9, 0.98), weight_decay=1e-4),
            "prior": torch.optim.AdamW(
                [p for part in (self.time, net.embed, net.blocks, net.norm, net.denoise) for p in part.parameters()],
                betas=(0.9, 0.98),
                weight_decay=1e-2,
            ),
            "objects": torch.optim.AdamW(
                [p for n, p in self.net.objects.named_parameters() if not n.startswith("shade.")], betas=(0.9, 0.98), weight_decay=1e-2
            ),
            "shade": torch.optim.AdamW(self.net.objects.shade.parameters(), betas=(0.9, 0.98), weight_decay=3e-2),
            "enhancer": torch.optim.AdamW(
                [p for n, p in self.net.named_parameters() if not n.startswith(FROZEN)], betas=(0.9, 0.98), weight_decay=1e-2
            ),
        }

    def parts(self) -> dict:
        return {"autoencoder": self.autoencoder, "time": self.time, "net": self.net, "average": self.average} | {
            f"optimiser {k}": v for k, v in self.optimiser.items()
        }

    def lost(self, stage: str, loss: torch.Tensor) -> None:
        """Count a step and its loss, which is not read here: that would wait for the GPU."""
        loss = loss.detach()
        self._loss[stage] = torch.lerp(self._loss.get(stage, loss), loss, 0.02)
        self.step[stage] += 1

    def loss(self, stage: str) -> float | None:
        """The stage's loss, smoothed over some 50 steps; None where none is known, as before its first step. ValueError where one since the
        start was not finite."""
        loss = float(self._loss[stage]) if stage in self._loss else None
        if loss is not None and not np.isfinite(loss):
            where = f"by step {self.step[stage]}"
            raise ValueError(f"the {stage}'s loss is {loss} {where}; check the pairs for damaged files, or lower the rate")
        return loss

    def save(self, path: Path) -> None:
        """Write the checkpoint from which `load` goes on. ValueError where a loss is not finite: the former checkpoint stays."""
        losses = {stage: self.loss(stage) for stage in self._loss}  # weights that are spoilt must not take the place of good ones
        state = {name: part.state_dict() for name, part in self.parts().items()}
        facts = {"config": asdict(self.config), "seed": self.seed, "step": self.step, "seconds": self.seconds, "told": self.told}
        save_state(path, {**facts, "loss": losses, **state})

    def load(self, path: Path) -> None:
        """Go on from a checkpoint. ValueError where that is not whole, or of a training of something else."""
        state = opened(path)
        if state["seed"] != self.seed:
            raise ValueError(f"{path} was begun with seed {state['seed']}, not {self.seed}; resume with --seed {state['seed']}")
        before = state["config"] | state.get("told", {})
        for name, value in (asdict(self.config) | self.told).items():
            if before.get(name, value) != value:
                was, now = ("other ones", "these") if name == "pairs" else (before[name], value)
                fix = "resume with the same command, or choose another folder"
                raise ValueError(f"{path} was begun with the {name} {was}, not {now}; {fix}")
        try:
            for name, part in self.parts().items():
                part.load_state_dict(state[name])
            self.step, self.seconds = state["step"], state["seconds"]
            self._loss = {k: torch.tensor(v, device=self.device) for k, v in state.get("loss", {}).items()}
        except (LookupError, RuntimeError, ValueError) as error:
            raise _broken(path, error) from error

    def share(self, stage: str) -> float:
        """A stage's share of the budget, of which those that are left out take nothing."""
        c = self.config
        all_of = {"autoencoder": c.autoencoder, "prior": c.prior, "objects": c.objects, "shade": c.shade}
        all_of["enhancer"] = 1 - sum(all_of.values())
        return all_of[stage] / sum(all_of[s] for s in self.stages) if stage in self.stages else 0.0

    def passed(self, stage: str) -> bool:
        """Whether a later stage has begun."""
        return any(self.step[other] for other in STAGES[STAGES.index(stage) + 1 :])

    def done(self, stage: str) -> float:
        """How much of a stage's budget is spent, 0 to 1: all where a later one has begun, though the budget be longer now, since what a
        stage learnt is lost where an earlier one goes on below it."""
        share = self.share(stage)
        if share <= 0 or self.passed(stage):
            return 1.0
        if self.steps is not None:
            return min(1.0, self.step[stage] / max(share * self.steps, 1))
        return min(1.0, self.seconds[stage] / 60 / max(share * (self.minutes or 0), 1e-9))

    def set_rate(self, stage: str) -> None:
        """Warm up over 100 steps, then half a cosine down to a hundredth."""
        highest = self.config.rate * RATES.get(stage, 1.0) * (1.0 if "autoencoder" in self.stages else 0.5)
        rate = highest * min(1.0, (self.step[stage] + 1) / 100) * (0.505 + 0.495 * np.cos(np.pi * self.done(stage)))
        for group in self.optimiser[stage].param_groups:
            group["lr"] = float(rate)


def opened(path: Path) -> dict:
    """What `Run.save` wrote; ValueError where a file is nothing of the kind."""
    try:
        state = load_state(path)
        TrainConfig(**state["config"])
        return state
    except (LookupError, TypeError, ValueError, OSError) as error:
        raise _broken(path, error) from error


def _broken(path: Path, error: Exception) -> ValueError:
    why = str(error).splitlines()[0] if str(error) else type(error).__name__
    return ValueError(f"{path} is not a checkpoint of this training ({why}); delete it to start again")
