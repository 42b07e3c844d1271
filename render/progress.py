"""Long work tells how far it is: a bar on a terminal, a plain line every few seconds elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

T = TypeVar("T")
PLAIN_SECONDS = 5.0
BAR_SECONDS = 0.1
BAR_WIDTH = 24


class Progress:
    """Counts steps of one piece of work and says so on stderr.

    with Progress("fit", total=3000) as steps:
        for ...: steps.step(note="28.1 dB")
    """

    def __init__(self, label: str, total: int | None = None, stream=None):
        self.label, self.total, self.note, self.done = label, total, "", 0
        self.before = 0
        self.stream = stream or sys.stderr
        self.bar = self.stream.isatty()
        self.start = self.said = time.monotonic()
        self._first: tuple[float, int] | None = None  # when the first step was done, which may compile kernels for minutes, and the count
        self._told: tuple[int, str] | None = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, kind, value, trace) -> None:
        if kind is not None and not self.done:
            return  # nothing was begun, and the error says why
        self._say()
        if self.bar:
            self.stream.write("\n")
            self.stream.flush()

    def step(self, count: int = 1, note: str | None = None) -> None:
        """`count` more steps are done; `note` stands behind the count until the next note."""
        self.done += count
        if self._first is None and count:
            self._first = time.monotonic(), self.done
        self.note = self.note if note is None else note
        if time.monotonic() - self.said >= (BAR_SECONDS if self.bar else PLAIN_SECONDS):
            self._say()

    def resume(self, count: int) -> None:
        """`count` steps were done in an earlier run: they are counted, and say nothing of how fast this one is."""
        self.done = self.before = count

    def line(self) -> str:
        """The state in words: label, count, rate or time left, note."""
        spent = time.monotonic() - self.start
        of = f"/{self.total}" if self.total else ""
        parts = [f"{self.label} {self.done}{of}"]
        now = self.done - self.before
        begun, first = self._first or (self.start, self.before)
        if self.total and self.done > first and self.done < self.total:
            left = (time.monotonic() - begun) * (self.total - self.done) / (self.done - first)
            parts.append(f"{_clock(left)} left")
        elif now:
            parts.append(_clock(spent))
        return "  ".join(parts + ([self.note] if self.note else []))

    def _say(self) -> None:
        self.said = time.monotonic()
        if self.bar:
            filled = round(BAR_WIDTH * min(1.0, self.done / self.total)) if self.total else 0
            bar = f"[{'#' * filled}{'.' * (BAR_WIDTH - filled)}] " if self.total else ""
            self.stream.write(f"\r\x1b[K{bar}{self.line()}")
        elif self._told != (self.done, self.note):
            self._told = self.done, self.note
            self.stream.write(self.line() + "\n")
        self.stream.flush()


def progress(items: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """`items` one by one, counted; `total` where `items` has no length."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with Progress(label, total) as steps:
        for item in items:
            yield item
            steps.step()


class Stopwatch:
    """Where the time goes, by stage. Stages nest, and the inner one's time is not counted to the outer one."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._running: list[str] = []
        self._since = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self._switch()
        self._running.append(name)
        self.seconds.setdefault(name, 0.0)
        try:
            yield
        finally:
            self._switch()
            self._running.pop()

    def during(self, name: str, items: Iterable[T]) -> Iterator[T]:
        """`items` one by one; the making of each counts to the stage."""
        source = iter(items)
        while True:
            with self.stage(name):
                try:
                    item = next(source)
                except StopIteration:
                    return
            yield item

    def milliseconds(self, count: int) -> dict[str, float]:
        """Mean milliseconds of each stage over `count` frames."""
        return {name: round(1000 * s / max(count, 1), 3) for name, s in self.seconds.items()}

    def _switch(self) -> None:
        now = time.perf_counter()
        if self._running:
            self.seconds[self._running[-1]] += now - self._since
        self._since = now


def _clock(seconds: float) -> str:
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{int(seconds // 60)} min {int(seconds % 60):02d} s"
