"""Work in steps that Ctrl-C or SIGTERM may end between any two of them, so that what is saved then is whole."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from scenes.atomic import FULL
from scenes.warnings import warn


class Stops:
    """Within the block Ctrl-C and SIGTERM are kept for `end`; a second one ends the work at once.

    with Stops() as stops:
        while more:
            step()
            if stops.asked:
                save()
                stops.end()

    What ignores a signal, as a shell's background jobs do Ctrl-C, goes on ignoring it. Only the main thread may listen to signals; on
    others nothing is kept, and there is no Ctrl-C either.
    """

    def __init__(self) -> None:
        self.asked: int | None = None
        self._former: dict[int, object] = {}

    def __enter__(self) -> Stops:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) is not signal.SIG_IGN:
                    self._former[number] = signal.signal(number, self._ask)
        return self

    def _ask(self, number: int, _frame) -> None:
        if self.asked is not None:
            self.end()
        self.asked = number

    def end(self) -> None:
        """KeyboardInterrupt or, after SIGTERM, SystemExit where a stop was asked for."""
        if self.asked == signal.SIGTERM:
            sys.exit(128 + signal.SIGTERM)
        if self.asked is not None:
            raise KeyboardInterrupt

    def __exit__(self, kind, *_problem) -> None:
        for number, former in self._former.items():
            signal.signal(number, former)  # type: ignore[arg-type]  # what `signal` gave
        if kind is None:
            self.end()  # what was asked for after the last step, too


def resumed(checkpoint: Path) -> str:
    """How work goes on that keeps a checkpoint there, for `stopped_saying`."""
    return "the same command with --resume goes on from here" if checkpoint.exists() else "nothing was kept yet; give the command again"


@contextmanager
def stopped_saying(how: Callable[[], str]) -> Iterator[None]:
    """Who stops what happens within is told how it goes on, by Ctrl-C or by SIGTERM, which ends with a code of its own; so is whose disk
    has no room for it, by a note of the error."""
    try:
        yield
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"interrupted; {how()}") from None
    except SystemExit:
        warn([f"stopped; {how()}"])
        raise
    except OSError as error:
        if error.errno in FULL:
            error.add_note(how())
        raise
