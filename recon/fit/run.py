"""A fit from where it stands to its end, which Ctrl-C may interrupt at any step."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable

from recon.fit.fit import Fit


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
