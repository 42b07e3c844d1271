"""Which splats a fit has: some are added, dropped, and given the colours of others as it goes on, each with what it carries."""

from __future__ import annotations

from collections.abc import Callable

import torch

from recon.fit.clear import Clear
from recon.fit.config import FitConfig
from recon.fit.densify import Growth, grow, joined, kept, shade_of
from recon.fit.descent import COLOURS, Descent
from recon.fit.flat import FlatGround
from recon.fit.halves import ROOM, halves, outdone
from recon.fit.model import Splats
from recon.fit.motion import Motion
from recon.fit.reach import reach_of
from recon.fit.swept import Swept
from recon.fit.unseen import LOW, SEEN, Shown, as_neighbours, curtains, off_ground, pennants, swollen
from recon.fit.veils import Veils
from recon.seeds.points import fewer
from scenes.gaussians import Gaussians
from scenes.trajectory import Trajectory


class Population:
    """The splats of a fit, and what each carries.

    splats; descent, growth: of each of them; guessed: bool `[N]`, what no picture shows: it keeps its colours, and
    movers' all that it is; None before any is. nearest: metres of the path within which nothing is seen sharper.
    """

    def __init__(
        self,
        splats: Splats,
        motion: Motion,
        config: FitConfig,
        ground: FlatGround,
        swept: Swept,
        clear: Clear,
        veils: Veils,
        nearest: float,
    ):
        self.device = splats.reach.device
        self.splats, self.motion, self.config = splats, motion, config
        self.nearest = nearest
        self.swept, self.clear, self.veils = swept.to(self.device), clear, veils
        self.flat_ground, self.ground = ground, ground.ground
        self.growth, self.descent = Growth.none(len(splats), self.device), Descent.begin(splats)
        self.guessed: torch.Tensor | None = None

    def grow(self, progress: float) -> None:
        """Split where most is wrong and pictures pull, drop what does not show. progress: the part of the fit that is done."""
        left = max(1, int((self.config.grow_span[1] - progress) * self.config.steps / self.config.grow_every) + 1)
        carried, astray = self.descent.tensors(), self.swept.holds(self.splats) | self.veils.holds(self.splats)
        budget = round(self.config.budget * (1 - ROOM)) if self.motion.tracks else self.config.budget
        self._renew(*grow(self.splats, carried, self.growth, budget, left, self.motion.boxes, astray))

    def add(self, more: Gaussians, path: Trajectory) -> None:
        """Some more of the background, as many as the budget leaves room for. path: of the body, along which cameras see them."""
        more = fewer(more, max(0, self.config.budget - len(self.splats)))
        reach = reach_of(more, path, self.motion.rig, self.nearest).to(self.device)
        self._renew(*joined(self.splats, self.descent.tensors(), [more], [reach]))

    def drop(self, which: torch.Tensor) -> None:
        """Go on without some, bool `[N]`."""
        self._renew(*kept(self.splats, self.descent.tensors(), ~which))

    @torch.no_grad()
    def guess(self, shown: Callable[[], Shown]) -> None:
        """Complete vehicles, and give what pictures hardly show its neighbours' colours, to keep, once what went astray, hangs or swelled
        is gone; of movers it rests from then on. shown: what pictures show of the splats there are by then."""
        self.drop(self.swept.holds(self.splats) | self.clear.holds(self.splats) | self.veils.holds(self.splats))
        seen = shown()
        hang = curtains(self.splats, seen.inside, self.descent.coloured(), self.ground) | pennants(self.splats, seen, self.ground)
        hang |= swollen(self.splats, seen.part)
        self.drop(hang)
        part = self._complete(seen.part[~hang], shown)
        self.guessed = as_neighbours(self.splats, part, self.descent.coloured(), self.ground)
        self.flat_ground.lay(self.splats, self.guessed & (off_ground(self.splats, self.ground) < LOW))
        unseen_movers = (part < SEEN) & (self.splats.group_of() > 0) & ~shade_of(self.splats)
        self.guessed |= unseen_movers
        self.descent.still(self.guessed, COLOURS)
        self.descent.still(unseen_movers)

    def keep_guesses(self, shown: Splats, which: torch.Tensor) -> None:
        """Take gradients from those of splats `which` `[M]` that are guessed: of the street those that would colour them, since it may
        still grow to close gaps, of movers all, since the rims by which they are seen would stretch them."""
        if self.guessed is None:
            return
        guessed = self.guessed[which]
        movers = guessed.clone()
        movers[: shown.sizes[0]] = False
        for name, field in shown.fields.items():
            if field.grad is not None:
                still = guessed if name == "sh" else movers
                field.grad.masked_fill_(still.view(-1, *[1] * (field.ndim - 1)), 0.0)

    def _complete(self, part: torch.Tensor, shown: Callable[[], Shown]) -> torch.Tensor:
        """Give vehicles the halves and sides that no picture shows. part: what pictures show of each splat `[N]`; returned of all there
        are then."""
        more, reach = halves(self.splats, part, self.motion.tracks)
        if not any(map(len, more)):
            return part
        splats, carried = joined(self.splats, self.descent.tensors() | {"part": part, "old": torch.ones_like(part)}, more, reach)
        part, old = carried.pop("part"), carried.pop("old") > 0
        self._renew(splats, carried)
        out = outdone(self.splats, part, old, shown().part, self.config.budget)
        self.drop(out)
        return part[~out]

    def _renew(self, splats: Splats, carried: dict[str, torch.Tensor]) -> None:
        """Go on with other splats, and what each carries with it."""
        self.splats, self.descent = splats, Descent(**carried)
        self.growth, self.guessed = Growth.none(len(splats), self.device), None

    def tensors(self) -> dict:
        """All of it, as tensors and numbers."""
        carried = {"growth": self.growth.tensors(), "descent": self.descent.tensors(), "guessed": self.guessed}
        return {"fields": self.splats.fields, "sizes": self.splats.sizes, "reach": self.splats.reach} | carried

    def restore(self, state: dict) -> None:
        """Go on from `tensors()`, on whichever device."""

        def here(tensors: dict[str, torch.Tensor]) -> dict[str, torch.Tensor]:
            return {name: tensor.to(self.device) for name, tensor in tensors.items()}

        self.splats = Splats(state["fields"], state["sizes"], state["reach"]).to(self.device)
        self.growth, self.descent = Growth(**here(state["growth"])), Descent(**here(state["descent"]))
        self.guessed = None if state["guessed"] is None else state["guessed"].to(self.device)
