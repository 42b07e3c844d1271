"""A fit from where it stands to its end, which Ctrl-C may interrupt at any step."""

from __future__ import annotations

import time
from collections.abc import Callable

from recon.fit.fit import Fit
from scenes.stops import Stops


def run(fit: Fit, save: Callable[[], None], report: Callable[[Fit], None], every_seconds: float = 45.0) -> None:
    """Step to the end, calling `report` each step and `save` now and then.

    Ctrl-C and SIGTERM let the step end, so that what is saved is whole, save, and then raise KeyboardInterrupt or SystemExit (`Stops`).
    """
    saved = time.monotonic()
    with Stops() as stops:
        while fit.step_count < fit.config.steps:
            fit.step()
            report(fit)
            if stops.asked or time.monotonic() - saved > every_seconds:
                save()
                saved = time.monotonic()
            stops.end()
