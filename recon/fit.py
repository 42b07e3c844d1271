"""The fit: rendered pictures are compared with recorded ones, and splats, sky, exposures and poses follow the gradient."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F

from recon.densify import Growth, adjusted, grow
from recon.frames import Frames, View
from recon.losses import PictureLoss
from recon.model import FIELDS, Splats, draw, placed_groups
from recon.motion import REFINED, Motion
from render.rays import world_directions
from scenes.camera import Camera
from scenes.sky import sample_equirect

SKY_STEP = 8
"""Pixels between sky samples; between them the sky is interpolated. It is smooth, and a lookup a pixel would cost as much as the splats."""


@dataclass(frozen=True)
class FitConfig:
    """How long and how finely to fit."""

    steps: int = 5000
    """Pictures rendered and compared."""
    budget: int = 220_000
    """Splats at most, all groups together."""
    sh_degree: int = 1
    """Harmonics of the splats' colours; they rise from 0 a quarter of the way in."""
    stages: tuple[tuple[float, int], ...] = ((0.0, 4), (0.15, 2), (0.4, 1))
    """From which part of the fit on pictures are shrunk by which factor: coarse to fine."""
    grow_every: int = 100
    """Steps between densifications."""
    grow_span: tuple[float, float] = (0.06, 0.6)
    """Part of the fit within which splats are added."""
    refine: tuple[str, ...] = (*REFINED, "exposures")
    """What is corrected besides the splats and the sky: poses and clocks by kind, and the cameras' exposures against the first's."""
    poses_from: float = 0.1
    """Part of the fit from which poses are corrected."""
    dissimilarity: float = 0.2
    """Weight of 1 - SSIM against L1."""
    still_weight: float = 0.4
    """How often a view is drawn while the car stands, against one while it drives."""
    seed: int = 0
    """Of the order of views."""


SKY_WEIGHT = 0.03
"""Of the alpha of pixels that are surely sky, beside the picture's loss: haze before the sky shows from elsewhere."""

SOLID_WEIGHT = 0.1
"""Of 1 - alpha of pixels below the horizon: a road that the sky shines through looks right from the recorded path alone."""

ASIDE, ASIDE_EVERY = 3.0, 4
"""Metres to either side of the path from which the road must be closed too, and every how many steps that is looked at."""

HORIZON = -0.01
"""Rays that fall more than this (half a degree) are below the horizon where no photo says what is sky."""

FADE = 0.003
"""Logit that a splat loses each time it is seen, unless the pictures hold it up: what nothing needs, goes."""

RATES = {"means": 1e-4, "quats": 2e-3, "log_scales": 8e-3, "logits": 4e-2, "dc": 5e-3, "rest": 5e-4}
"""Adam's step a field; of means in parts of each splat's reach: 0.1 pixel."""


class Fit:
    """The state of a fit: step it, checkpoint it with `state`, go on with `restore`."""

    def __init__(
        self,
        frames: Frames,
        motion: Motion,
        splats: Splats,
        sky: torch.Tensor,
        exposures: torch.Tensor,
        config: FitConfig,
    ):
        self.frames, self.motion, self.config = frames, motion, config
        self.splats, self.sky, self.exposures = splats, sky, exposures
        self.step_count = 0
        self.training = frames.training()
        self.generator = torch.Generator().manual_seed(config.seed)
        self.growth = Growth.none(len(splats))
        self.recent_loss = 0.0
        self._pyramid: dict[tuple[int, int], torch.Tensor] = {}
        self._weights = self._chances()
        self._optimise()

    def _chances(self) -> torch.Tensor:
        """How often each training view is drawn: less while the car stands."""
        drawn = [self.motion.row[v.camera, v.index] for v in self.training]
        return torch.where(self.motion.speeds()[drawn] > 0.5, 1.0, self.config.still_weight)

    def _optimise(self) -> None:
        """Optimisers over the present tensors. The splats' own is made anew whenever their number changes; its moments are carried over."""
        poses, exposures = self.motion.parameters(self.config.refine), [self.exposures] * ("exposures" in self.config.refine)
        for tensor in [*self.splats.fields.values(), self.sky, *exposures, *poses]:
            tensor.requires_grad_(True)
        self.splat_adam = adam([{"params": [self.splats.fields[k]], "lr": RATES[k]} for k in FIELDS], eps=1e-15)
        self.rest_adam = adam([{"params": [self.sky], "lr": 2e-3}, {"params": exposures, "lr": 5e-4}], eps=1e-12)
        self.pose_adam = adam([{"params": poses, "lr": 0.03}], eps=1e-12)

    @property
    def progress(self) -> float:
        return self.step_count / self.config.steps

    def sh_count(self) -> int:
        degree = min(self.config.sh_degree, int(self.progress * 4))
        return (degree + 1) ** 2

    def shrink(self) -> int:
        return next(factor for start, factor in reversed(self.config.stages) if self.progress >= start)

    # ---- one step

    def step(self) -> float:
        """Draw a view, render it, compare, and follow the gradient. Returns the loss."""
        if self.step_count and self.step_count % self.config.grow_every == 0 and self._growing():
            self._grow()
        view = self.training[int(torch.multinomial(self._weights, 1, generator=self.generator))]
        camera = self.motion.camera(view).resized(*self._size(self.shrink()))
        target = self._target(view, self.shrink())
        rgb, alpha = self.render(view, camera)
        loss = PictureLoss.apply(rgb, target, self.config.dissimilarity, self._window(camera))
        coarse = F.interpolate(alpha[None, None], view.sky.shape)[0, 0]
        haze = SKY_WEIGHT * (coarse * view.sky).mean() + SOLID_WEIGHT * ((1 - coarse) * self._below(camera, view)).mean()
        if self.step_count % ASIDE_EVERY == 0:
            haze = haze + SOLID_WEIGHT * self._gaps_aside(view, camera)
        (loss + haze + self.motion.unrest() + 1e-3 * (self.exposures[:, :, 3].square().sum())).backward()
        self._follow()
        self.step_count += 1
        value = float(loss.detach())
        self.recent_loss = value if self.recent_loss == 0 else 0.98 * self.recent_loss + 0.02 * value
        return value

    def render(self, view: View, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
        """Picture `[H, W, 3]` and alpha of a view by the present state, exposed as its camera exposes."""
        placed = placed_groups(self.splats.groups(self.sh_count()), self.motion.actor_poses(view, camera))
        rgb, alpha = draw(self.motion.as_read(placed, view, camera), camera, "rgb", "alpha")
        rgb = rgb + (1 - alpha)[..., None] * self._sky_behind(camera)
        exposure = self.exposures[view.camera]
        return rgb @ exposure[:, :3].T + exposure[:, 3], alpha

    def _below(self, camera: Camera, view: View) -> torch.Tensor:
        """Where a view surely looks at something: below the horizon and not at its sky; bool, of `view.sky`'s shape."""
        small = camera.resized(view.sky.shape[1], view.sky.shape[0])
        return (world_directions(small)[..., 2] < 0) & ~view.sky

    def _gaps_aside(self, view: View, camera: Camera) -> torch.Tensor:
        """Mean of 1 - alpha below the horizon, of a small picture taken up to `ASIDE` metres to the left or right of a view."""
        metres = ASIDE * (2 * float(torch.rand((), generator=self.generator)) - 1)
        pose = camera.world_from_cam.detach().clone()
        pose[:3, 3] += metres * self.motion.left(view)
        small = replace(camera, world_from_cam=pose).resized(*self._size(2 * self.shrink()))
        placed = placed_groups(self.splats.groups(self.sh_count()), self.motion.actor_poses(view, small))
        (alpha,) = draw(placed, small, "alpha")
        return ((1 - alpha) * (world_directions(small)[..., 2] < HORIZON)).mean()

    def _sky_behind(self, camera: Camera) -> torch.Tensor:
        """Sky colour `[H, W, 3]` at every pixel: sampled every few pixels, at others each time, or those between would never learn."""
        shift = torch.randint(0, SKY_STEP, (2,), generator=self.generator)
        sides = torch.tensor([camera.height, camera.width])
        y, x = (SKY_STEP * (torch.arange(n) + 0.5) - float(s) for n, s in zip((sides // SKY_STEP + 2).tolist(), shift, strict=True))
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), -1).double()
        rays = camera.lens.unproject(pixels) @ camera.world_from_cam[:3, :3].detach().T
        colours = sample_equirect(self.sky, rays).permute(2, 0, 1)[None]
        fine = F.interpolate(colours, scale_factor=SKY_STEP, mode="bilinear", align_corners=False)[0].permute(1, 2, 0)
        top, left = shift.tolist()
        return fine[top : top + camera.height, left : left + camera.width]

    def _size(self, shrink: int) -> tuple[int, int]:
        return max(16, self.frames.width // shrink), max(16, self.frames.height // shrink)

    def _target(self, view: View, shrink: int) -> torch.Tensor:
        if shrink == 1:
            return view.image.float() / 255
        key = (shrink, self.motion.row[view.camera, view.index])
        if key not in self._pyramid:
            width, height = self._size(shrink)
            small = F.interpolate(view.image.permute(2, 0, 1)[None].float(), (height, width), mode="area")[0].permute(1, 2, 0)
            self._pyramid = {k: v for k, v in self._pyramid.items() if k[0] == shrink}
            self._pyramid[key] = small.contiguous()
        return self._pyramid[key] / 255

    def _window(self, camera: Camera) -> tuple[int, int, int, int]:
        """Where similarity is taken: all of a small picture, a random part of a large one."""
        height, width = min(camera.height, 270), min(camera.width, 480)
        top, left = (int(torch.randint(0, n + 1, (1,), generator=self.generator)) for n in (camera.height - height, camera.width - width))
        return top, left, height, width

    def _follow(self) -> None:
        fields, decay = self.splats.fields, 0.01**self.progress
        assert fields["means"].grad is not None
        seen = self.growth.see(fields["means"].grad, self.splats.reach)
        settle = 0.1 ** max(0.0, (self.progress - 0.6) / 0.4)
        for group, name in zip(self.splat_adam.param_groups, FIELDS, strict=True):
            group["lr"] = RATES[name] * (decay if name == "means" else settle)
        before = fields["means"].detach().clone()
        if fields["rest"].grad is None:
            fields["rest"].grad = torch.zeros_like(fields["rest"])
        self.splat_adam.step()
        with torch.no_grad():
            # Adam's step has one length for all; a far splat must move further to move a pixel
            fields["means"].sub_(before).mul_(self.splats.reach[:, None]).add_(before)
            fields["logits"].sub_(seen, alpha=FADE)
            adjusted(self.splats)
        if self.exposures.grad is not None:
            self.exposures.grad[0] = 0  # the first camera is the reference
        self.rest_adam.step()
        if self.progress >= self.config.poses_from:
            self.pose_adam.param_groups[0]["lr"] = 0.03 * max(0.1, 1 - self.progress)
            self.pose_adam.step()
        for optimiser in (self.splat_adam, self.rest_adam, self.pose_adam):
            optimiser.zero_grad(set_to_none=True)

    # ---- growth

    def _growing(self) -> bool:
        return self.config.grow_span[0] <= self.progress <= self.config.grow_span[1]

    def _grow(self) -> None:
        """Split where the gradient pulls, drop what does not show."""
        left = max(1, int((self.config.grow_span[1] - self.progress) * self.config.steps / self.config.grow_every) + 1)
        moments = {k: self.splat_adam.state.get(self.splats.fields[k], {}) for k in FIELDS}
        steps = {k: m.get("step") for k, m in moments.items()}
        pairs = {k: (m.get("exp_avg"), m.get("exp_avg_sq")) for k, m in moments.items()}
        self.splats, carried = grow(self.splats, pairs, self.growth, self.config.budget, left, self.motion.boxes)
        self.growth = Growth.none(len(self.splats))
        for tensor in self.splats.fields.values():
            tensor.requires_grad_(True)
        self.splat_adam = adam([{"params": [self.splats.fields[k]], "lr": RATES[k]} for k in FIELDS], eps=1e-15)
        for k, (first, second) in carried.items():
            if first is not None:
                self.splat_adam.state[self.splats.fields[k]] = {"step": steps[k], "exp_avg": first, "exp_avg_sq": second}

    # ---- checkpoints

    def tensors(self) -> dict:
        """All that changes, as tensors and numbers: what a checkpoint holds."""
        return {
            "fields": {k: v.detach() for k, v in self.splats.fields.items()},
            "sizes": self.splats.sizes,
            "reach": self.splats.reach,
            "growth": self.growth.tensors(),
            "sky": self.sky.detach(),
            "exposures": self.exposures.detach(),
            "motion": self.motion.tensors(),
            "adam": [o.state_dict() for o in (self.splat_adam, self.rest_adam, self.pose_adam)],
            "generator": self.generator.get_state(),
            "step": self.step_count,
            "loss": self.recent_loss,
        }

    def restore(self, state: dict) -> None:
        """Go on from `tensors()` of another run: the same steps follow as would have followed there."""
        self.splats = Splats(state["fields"], state["sizes"], state["reach"])
        self.growth = Growth(**state["growth"])
        self.sky, self.exposures = state["sky"], state["exposures"]
        self.motion.restore(state["motion"])
        self._optimise()
        for optimiser, saved in zip((self.splat_adam, self.rest_adam, self.pose_adam), state["adam"], strict=True):
            optimiser.load_state_dict(saved)
        self.generator.set_state(state["generator"])
        self.step_count, self.recent_loss = state["step"], state["loss"]


def adam(groups: list[dict], eps: float) -> torch.optim.Adam:
    return torch.optim.Adam(groups, betas=(0.9, 0.999), eps=eps, fused=True)


def run(fit: Fit, save: Callable[[], None], report: Callable[[Fit], None], every_seconds: float = 45.0) -> None:
    """Step to the end, calling `report` each step and `save` now and then.

    Ctrl-C lets the step end, so that what is saved is whole, saves, and then raises KeyboardInterrupt; a second one does at once.
    """
    asked: list[bool] = []

    def ask(_signal, _frame) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(True)

    # only the main thread may listen to signals; elsewhere there is no Ctrl-C either
    listening = threading.current_thread() is threading.main_thread()
    former = signal.signal(signal.SIGINT, ask) if listening else None
    saved = time.monotonic()
    try:
        while fit.step_count < fit.config.steps:
            fit.step()
            report(fit)
            if asked or time.monotonic() - saved > every_seconds:
                save()
                saved = time.monotonic()
            if asked:
                raise KeyboardInterrupt
    finally:
        if listening:
            signal.signal(signal.SIGINT, former)
