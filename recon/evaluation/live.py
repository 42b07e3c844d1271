"""How good a fit is while it runs: held-out pictures, drawn now and then by what there is by then."""

from __future__ import annotations

from collections.abc import Sequence

from recon.evaluation.report import DRIVING, EQUAL_DB
from recon.fit.fit import Fit
from render.compare import psnr
from scenes.spread import spread

EVERY = 25
"""Steps from a look to the next: a look costs a third of a step."""

LOOKS = 6
"""Pictures that are looked at in turn, spread over where the car drives."""


class Live:
    """PSNR of the first camera's held-out pictures at full size, looked at in turn; in words, the mean of the last look at each.

    curve: a row [step, seconds, dB] at the end of every turn, from the first of an interrupted fit on. A fit that holds out nothing says
    nothing.
    """

    def __init__(self, fit: Fit, curve: Sequence[list[float]] = ()):
        views, speeds = fit.frames.of(0, held_out=True), fit.motion.speeds()
        driving = [v for v in views if speeds[fit.motion.row[v.camera, v.index]] > DRIVING]
        self.views = [v.to(fit.device) for v in spread(driving or views, LOOKS)] if views else []
        self.curve = list(curve)
        self._seen: dict[int, float] = {}

    def look(self, fit: Fit, seconds: float) -> None:
        """Look at one more picture if it is time; seconds: what the fit has taken."""
        if not self.views or fit.step_count % EVERY:
            return
        place = fit.step_count // EVERY % len(self.views)
        view = self.views[place]
        alike = psnr(fit.picture(view), view.image.float() / 255, None if view.ego is None else ~view.ego)
        self._seen[place] = min(alike, EQUAL_DB)
        if len(self._seen) == len(self.views) and place == 0:
            self.curve.append([fit.step_count, round(seconds, 1), round(self._mean(), 2)])

    def __str__(self) -> str:
        return f"held out {self._mean():.2f} dB" if self._seen else ""

    def _mean(self) -> float:
        return sum(self._seen.values()) / len(self._seen)
