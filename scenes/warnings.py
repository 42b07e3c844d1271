"""What a user should know though the work goes on, and though nobody can be told."""

from __future__ import annotations

import io
import sys
from collections.abc import Sequence


def warn(lines: Sequence[str]) -> None:
    for line in lines:
        print(f"sidestep: warning: {line}", file=sys.stderr)


class Undisturbed(io.RawIOBase):
    """A raw stream whose words are not worth the work that they tell of: what it does not take, as a log on a full disk or a terminal that
    was closed, is dropped. Not so a pipe that nobody reads any more, which is how a reader stops a command."""

    def __init__(self, stream: io.RawIOBase):
        self.stream = stream

    def writable(self) -> bool:
        return True

    def fileno(self) -> int:
        return self.stream.fileno()

    def isatty(self) -> bool:
        return self.stream.isatty()

    def write(self, data) -> int | None:
        try:
            return self.stream.write(data)
        except BrokenPipeError:
            raise
        except OSError:
            return len(data)
