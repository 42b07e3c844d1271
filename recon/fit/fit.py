"""The fit: rendered pictures are compared with recorded ones, and splats, sky, exposures and poses follow the gradient; what lies on the
ground is pressed flat besides."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from functools import partial

import torch

from recon.fit.agreement import BEGINS, Agreement
from recon.fit.densify import hold_shade, shade_of
from recon.fit.descent import rates_at
from recon.fit.develop import developed
from recon.fit.flat_field import FEWEST, FlatField, due
from recon.fit.limbs import Limbs
from recon.fit.lines import LOOKS, STRAIGHTENED_AT, StreetLines
from recon.fit.losses import STEP, PictureLoss
from recon.fit.model import Splats, dimmed_actors, draw, street_alone
from recon.fit.motion import Shot
from recon.fit.openings import Openings, aside_of
from recon.fit.population import Population
from recon.fit.refill import REFILLED_AT, missed
from recon.fit.sight import Eye, in_sight
from recon.fit.targets import Targets, ego_at, scale_of
from recon.fit.turns import Turns
from recon.fit.unseen import Shown
from recon.kernels.descent import Rates
from recon.kernels.develop import SKY_STEP
from recon.seeds.fill import Search
from recon.seeds.measured import Measured, mistake
from recon.views.frames import Frames
from recon.views.view import View
from render.launch import upload
from scenes.camera import Camera
from scenes.gaussians import Placed
from scenes.sky import sample_equirect
from scenes.spread import spread

SKY_RATE, EXPOSURE_RATE = 2e-3, 5e-4
"""Steps of the sky's colours and of cameras' exposures."""

SKY_PRIOR = 3e-6
"""Weight, in a step's gradient, of the squared distance of the sky from its initial picture: a twentieth of what a picture's sky weighs,
but more than what shines through a wall, which Adam would turn into noise that a shifted view shows between the houses."""

ASIDE_EVERY = 2
"""Steps between renders from beside the path, which show gaps that the path does not."""

BLAME_EVERY = 3
"""Steps between those that ask which splats show errors, as long as splats are added."""

GUESSED_FROM = 0.8
"""Part of the fit from which splats that pictures hardly show take their neighbours' colours, and movers' unseen sides are completed; the
rest is fitted on around them."""

CLIPPED = 0.99
"""Colour of a picture from which on it may be clipped."""

FADE = 0.003
"""Logit that a splat loses each time it is in sight, unless pictures hold it up: what nothing needs fades. It decays as the step sizes do,
which could not resist it at the end."""

RATES = {"means": 6e-4, "quats": 2e-3, "log_scales": 3.2e-2, "logits": 4e-2, "colours": 1e-2, "harmonics": 1e-3}
"""Adam's step sizes by field; of means as a part of each splat's reach, which is 0.3 pixels. A splat is in sight for a few hundred steps,
which must take it from its seed to what pictures show: with a sixth of the rate of means and a quarter of that of scales, fits ended half
way. Twice the rate of colours puts into colours what belongs into depth; of means, too, but that photos are compared."""


class Fit:
    """The state of a fit: step it, checkpoint it with `tensors`, go on with `restore`.

    It runs on the device of its splats, with sky, exposures, limbs, pictures and measured depths; poses stay on the host, and so do the
    generator and what is due, so that the same views are drawn on every device.
    """

    def __init__(
        self,
        frames: Frames,
        population: Population,
        sky: torch.Tensor,
        exposures: torch.Tensor,
        limbs: Limbs,
        measured: Sequence[Measured],
        flat_fields: Sequence[FlatField],
    ):
        self.device, self.motion, self.config = population.device, population.motion, population.config
        self.frames, self.population, self.limbs = frames, population, limbs
        self.measured = [m.to(self.device) for m in measured]
        self.sky, self.exposures = sky.to(self.device), exposures.to(self.device)
        self.first_sky, self.flat_fields = self.sky.clone(), flat_fields
        self.evened = self._evened()
        self.step_count = 0
        self.training = [view.to(self.device) for view in frames.training()]
        self.generator = torch.Generator().manual_seed(self.config.seed)
        self.recent_loss = 0.0
        self.targets = Targets()
        self.turns = Turns(self._weights(), self.generator)
        self.agreement = Agreement(self.training, self.motion, aside_of(measured))
        self.openings = Openings(frames, self.motion, self.device, aside_of(measured))
        gains = {v.time_us: frames.followed(v.time_us) for v in frames.views}
        self._followed = {time: None if gain is None else gain.to(self.device) for time, gain in gains.items()}
        self._optimise()

    def _weights(self) -> torch.Tensor:
        """How often each training view should be drawn: less while the car stands."""
        drawn = [self.motion.row[v.camera, v.index] for v in self.training]
        return torch.where(self.motion.speeds()[drawn] > 0.5, 1.0, self.config.still_weight)

    def _optimise(self) -> None:
        """Optimisers of what all pictures share; the splats have their own."""
        poses, exposures = self.motion.parameters(self.config.refine), [self.exposures] * ("exposures" in self.config.refine)
        for tensor in [self.sky, *exposures, *poses]:
            tensor.requires_grad_(True)
        self.rest_adam = adam([{"params": [self.sky], "lr": SKY_RATE}, {"params": exposures, "lr": EXPOSURE_RATE}], eps=1e-12)
        self.pose_adam = adam([{"params": poses, "lr": 0.03}], eps=1e-12)

    @property
    def splats(self) -> Splats:
        return self.population.splats

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
        self._tend()
        there, descent = self.population, self.population.descent
        view = self.training[self.turns.next()]
        shot = self.motion.shot(view, self.targets.size(view, self.shrink()))
        camera, target = shot.camera, self.targets.picture(view, self.shrink())
        aside = None
        if self.step_count % ASIDE_EVERY == 0:
            metres = self.openings.metres * (2 * float(torch.rand((), generator=self.generator)) - 1)
            beside = self.openings.aside(view, camera, metres).resized(*self.targets.size(view, 2 * self.shrink()))
            aside = self.motion.beside(shot, beside)
        rates = self._rates()
        which = self._in_sight(shot) if aside is None else self._in_sight(shot, aside)
        descent.catch_up(there.splats, which, self.sh_count(), rates)
        shown = there.splats.select(which, self.sh_count())  # copies, to be differentiated
        known, shade = self._known(view), shade_of(shown)
        by_lot = self._drawn_by_lot(shown)
        shift = torch.randint(0, SKY_STEP, (2,), generator=self.generator).tolist()
        blank = torch.zeros(len(shown), 1, device=self.device, requires_grad=True) if self._blaming() else None
        sky = self.openings.backdrop(self.sky, self.generator)
        other = self.agreement.other(view, self.generator) if known and self.progress >= BEGINS else None
        outputs = ["rgb", "alpha", *["depth"] * bool(known), *["instance"] * (other is not None), *["features"] * (blank is not None)]
        drawn = self._render(by_lot, shot, sky, shift, outputs, blank)
        rgb, alpha = self._judged(drawn["rgb"], target, view, camera), drawn["alpha"]
        if view.camera in self.evened:
            self.flat_fields[view.camera].compare(rgb, target)
        lattice = (STEP, *torch.randint(0, STEP, (2,), generator=self.generator).tolist())
        loss = PictureLoss.apply(rgb, target, self.config.dissimilarity, lattice)
        haze = self.openings.haze(alpha, view, camera)
        if blank is not None:
            wrong = (rgb.detach() - target).abs().mean(-1)
            haze = haze + (drawn["features"][..., 0] * wrong).sum()  # nothing, whose gradient says who shows errors
        if aside is not None:
            closing = self._placed(shown.held(there.flat_ground.on(shown), ("means", "quats")), aside)
            (solid,) = draw(street_alone(closing), aside.camera, "alpha", scale=scale_of(view, aside.camera))
            haze = haze + self.openings.gaps(solid, aside.camera)
        if known:
            weights, depths = zip(*known, strict=True)
            mistakes = mistake(drawn["depth"], alpha, torch.stack(depths)).unbind()
            haze = haze + sum(self.config.depth_weight * weight * each for weight, each in zip(weights, mistakes, strict=True))
        if other is not None:
            photos, field = (target, self.targets.picture(other, self.shrink())), self.flat_fields[view.camera].gains
            haze = haze + self._settled() * self.agreement.sampled(shot, drawn, photos, other, field, self.generator)
        unrest = self.limbs.unrest(shot.near, camera)
        whole = loss + haze + unrest + 1e-3 * (self.exposures[:, :, 3].square().sum())
        # beside one another, not added up: the poses' unrest is on the host
        torch.autograd.backward([cost for cost in (whole, self.motion.unrest()) if cost.requires_grad])
        there.keep_guesses(shown, which)
        hold_shade(shown, shade)
        value = float(loss.detach())  # before anything else is asked of the device, which the host would wait for here
        descent.follow(there.splats, which, shown, rates, there.growth)
        there.flat_ground.press(there.splats, which, descent, rates, self._settled(), camera.world_from_cam.detach()[:3, 3])
        if blank is not None and blank.grad is not None:
            there.growth.blame(which, blank.grad[:, 0] * self.shrink() ** 2)
        self._follow()
        self.step_count += 1
        self.recent_loss = value if self.recent_loss == 0 else 0.98 * self.recent_loss + 0.02 * value
        return value

    def _judged(self, rgb: torch.Tensor, target: torch.Tensor, view: View, camera: Camera) -> torch.Tensor:
        """The rendered picture of a view, as recorded where the record says nothing of the scene."""
        if view.ego is not None:
            rgb = torch.where(ego_at(view, camera), target, rgb)  # the recording car is no part of the scene
        if view.gain is not None:
            rgb = torch.where((target > CLIPPED) & (rgb > target), target, rgb)  # how much brighter it was, the picture does not say
        return rgb

    def _known(self, view: View) -> list[tuple[float, torch.Tensor]]:
        """The depths that a view is held to, and their weights."""
        if not self.config.depth_weight:
            return []
        return [(m.weight, m.views[view.camera, view.index]) for m in self.measured if (view.camera, view.index) in m.views]

    @torch.no_grad()
    def picture(self, view: View) -> torch.Tensor:
        """A view `[H, W, 3]`, held out or not, as the splats show it by now; the fit goes on as if nobody had looked."""
        return self._drawn(view, "rgb", "alpha")["rgb"]

    def _drawn(self, view: View, *outputs: str) -> dict[str, torch.Tensor]:
        """Outputs of a view at full size."""
        shot = self.motion.shot(view)
        shown = self.splats.select(self._in_sight(shot), self.sh_count())
        return self._render(shown, shot, partial(sample_equirect, self.sky), outputs=outputs)

    def _in_sight(self, *shots: Shot, of: Splats | None = None) -> torch.Tensor:
        """Indices of the splats that any of the pictures may show."""
        eyes: list[Eye] = [(shot.camera, *shot.backs()) for shot in shots]
        return in_sight(self.splats if of is None else of, eyes, {i for shot in shots for i in shot.near})

    def _render(
        self,
        shown: Splats,
        shot: Shot,
        sky: Callable[[torch.Tensor], torch.Tensor],
        shift: Sequence[int] = (0, 0),
        outputs: Sequence[str] = ("rgb", "alpha"),
        features: torch.Tensor | None = None,
    ) -> dict[str, torch.Tensor]:
        """Outputs of a shot by the splats in sight, by name: "rgb" `[H, W, 3]`, with the sky behind, exposed as its camera does; "alpha";
        "depth", and what the picture shows of the splats' `features` `[N, C]`, where they are wanted. shift: of the sky's samples
        (`developed`)."""
        placed, view, camera = self._placed(shown, shot), shot.view, shot.camera
        of_groups = None if features is None else features.split(shown.sizes)
        theirs = None if of_groups is None else [of_groups[p.instance] for p in placed]
        drawn = draw(placed, camera, *outputs, features=theirs, scale=scale_of(view, camera))
        found = dict(zip(outputs, drawn, strict=True))
        rgb = developed(found["rgb"], found["alpha"], sky, self._exposure(view), camera, shift)
        return found | {"rgb": self.flat_fields[view.camera].over(rgb)}

    def _exposure(self, view: View) -> torch.Tensor:
        """The affine exposure `[3, 4]` of a view: its camera's, as many times as it was exposed."""
        exposure = self.exposures[view.camera]
        return exposure if view.gain is None else view.gain[:, None] * exposure

    def _drawn_by_lot(self, shown: Splats) -> Splats:
        """Without `drop` of them, which rises over the first four fifths of the fit; the mean of all draws is as dense as all are."""
        share = self.config.drop * min(1.0, self.progress / 0.8)
        if share == 0:
            return shown
        opacity = torch.sigmoid(shown.fields["logits"])
        stays = upload(torch.rand(opacity.shape, generator=self.generator) >= share, opacity.device)
        denser = torch.where(stays, opacity / (1 - share), 0.0).clamp(1e-5, 0.999)
        return shown.changed(logits=torch.logit(denser))

    def _placed(self, shown: Splats, shot: Shot) -> list[Placed]:
        """The splats in sight where they are at a shot's moment, each, where rows are read one after the other, at its own row's."""
        splats = self.limbs.bent(dimmed_actors(shown, self._followed[shot.view.time_us]), shot.view.time_us)
        return self.motion.as_read(splats, shot).placed(shot.poses())

    def _settled(self) -> float:
        """How long steps still are: towards the end they become ever shorter."""
        return 0.1 ** max(0.0, (self.progress - 0.6) / 0.4)

    def _rates(self) -> Rates:
        settle = self._settled()
        steps = {name: rate * (0.01**self.progress if name == "means" else settle) for name, rate in RATES.items()}
        return rates_at(self.step_count + 1, steps, FADE * settle)

    def _follow(self) -> None:
        """The steps of what all pictures share."""
        if self.exposures.grad is not None:
            self.exposures.grad[0] = 0  # the first camera is the reference
        if self.sky.grad is not None:
            self.sky.grad.add_(self.sky.detach() - self.first_sky, alpha=SKY_PRIOR)
        # at full length to the end, steps would leave a lattice of dots in the sky, whose every other direction each of them moves alike
        for group, rate in zip(self.rest_adam.param_groups, (SKY_RATE, EXPOSURE_RATE), strict=True):
            group["lr"] = rate * self._settled()
        self.rest_adam.step()
        if self.progress >= self.config.poses_from:
            self.pose_adam.param_groups[0]["lr"] = 0.03 * max(0.1, 1 - self.progress)
            self.pose_adam.step()
        for optimiser in (self.rest_adam, self.pose_adam):
            optimiser.zero_grad(set_to_none=True)
        self.limbs.follow(self.progress)

    # ---- which splats there are

    def _tend(self) -> None:
        """Add, drop and colour splats, and even cameras out, where it is time to."""
        if self.step_count and self.step_count % self.config.grow_every == 0 and self._growing():
            self.population.grow(self.progress)
        if self._at(REFILLED_AT):
            self._refill()
        if self._at(STRAIGHTENED_AT):
            self._straighten()
        if due(self.step_count, self.config.steps):
            for camera in self.evened:
                self.flat_fields[camera].follow()
        if self.population.guessed is None and self.progress >= GUESSED_FROM:
            self.population.guess(self.shown)

    def _at(self, parts: Sequence[float]) -> bool:
        """Whether the next step is the first of one of these parts of the fit."""
        return self.step_count in [round(part * self.config.steps) for part in parts]

    def _evened(self) -> list[int]:
        """The cameras whose flat fields are found on the way."""
        cameras = range(len(self.flat_fields)) if "flat fields" in self.config.refine else ()
        return [c for c in cameras if len(self.frames.of(c)) >= FEWEST]

    def _blaming(self) -> bool:
        """Whether this step asks which splats show what is wrong."""
        return self.progress <= self.config.grow_span[1] and self.step_count % BLAME_EVERY == 0

    def _growing(self) -> bool:
        return self.config.grow_span[0] <= self.progress <= self.config.grow_span[1]

    @torch.no_grad()
    def _refill(self) -> None:
        """Add splats where the sky stands in for what pictures show, once what stands where lidar looked through is gone."""
        there = self.population
        there.drop(there.clear.holds(there.splats) | there.veils.holds(there.splats))
        path, sh_count = self.motion.path(), there.splats.fields["sh"].shape[1]
        for c in range(len(self.frames.names)):
            views, gain = self.frames.of(c), self.exposures[c].diagonal().cpu().numpy()
            cameras = [self.motion.camera(v) for v in views]
            search = Search(views, cameras, gain, there.ground, self.motion.tracks)
            for more in missed(search, self.frames, lambda v: self._drawn(v.to(self.device), "rgb", "alpha", "depth"), sh_count):
                there.add(more, path)

    def _straighten(self) -> None:
        """Let what lies along the street in pictures lie along it in space."""
        of_cameras = ([v for v in self.training if v.camera == c] for c in range(len(self.frames.names)))
        cameras = [self.motion.camera(view) for views in of_cameras for view in spread(views, LOOKS)]
        StreetLines(self.motion.path(), cameras, self.population.clear).straighten(self.splats)

    def shown(self, splats: Splats | None = None) -> Shown:
        """What the pictures show of each splat; of others that stand in their place, where these are given."""
        return self.shown_by((self.coarse(view).at_once() for view in self.training), splats)

    def coarse(self, view: View) -> Shot:
        """A training view, a quarter as large."""
        return self.motion.shot(view, self.targets.size(view, 4))

    @torch.no_grad()
    def shown_by(self, shots: Iterable[Shot], splats: Splats | None = None) -> Shown:
        """What these show of each splat."""
        splats = self.splats if splats is None else splats
        shown = Shown.none(len(splats), self.device)
        for shot in shots:
            which, camera = self._in_sight(shot, of=splats), shot.camera
            placed = self._placed(splats.select(which, 1), shot)
            shown.add(which, placed, camera, self.openings.beside_sky(shot.view, camera), scale_of(shot.view, camera))
        return shown

    # ---- checkpoints

    def tensors(self) -> dict:
        """All that changes, as tensors and numbers: what a checkpoint holds."""
        return self.population.tensors() | {
            "sky": self.sky.detach(),
            "first_sky": self.first_sky,
            "exposures": self.exposures.detach(),
            "flat_fields": [field.tensors() for field in self.flat_fields],
            "motion": self.motion.tensors(),
            "limbs": self.limbs.tensors(),
            "adam": [o.state_dict() for o in (self.rest_adam, self.pose_adam)],
            "due": self.turns.due,
            "generator": self.generator.get_state(),
            "step": self.step_count,
            "loss": self.recent_loss,
        }

    def restore(self, state: dict) -> None:
        """Go on from `tensors()` of another run, on whichever device: the same steps follow as would have followed there."""
        self.population.restore(state)
        self.sky, self.first_sky, self.exposures = (state[name].to(self.device) for name in ("sky", "first_sky", "exposures"))
        for field, saved in zip(self.flat_fields, state["flat_fields"], strict=True):
            field.restore(saved)
        self.motion.restore(state["motion"])
        self.limbs.restore(state["limbs"])
        self._optimise()
        for optimiser, saved in zip((self.rest_adam, self.pose_adam), state["adam"], strict=True):
            optimiser.load_state_dict(saved)
        self.turns.due = state["due"]
        self.generator.set_state(state["generator"])
        self.step_count, self.recent_loss = state["step"], state["loss"]


def adam(groups: list[dict], eps: float) -> torch.optim.Adam:
    return torch.optim.Adam(groups, betas=(0.9, 0.999), eps=eps, fused=True)
