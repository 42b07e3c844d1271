"""One command at a time changes a folder: what was read before it is written must not be lost to another that wrote meanwhile."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_HELD: set[tuple[int, int, int]] = set()
"""Device and number of the folders that are held, and by which thread."""


@contextmanager
def alone(folder: str | os.PathLike) -> Iterator[None]:
    """Hold a folder for a block that reads and changes it: other processes and threads that ask for it wait until the block ends, however
    it ends. Blocks of one thread may be nested. Nothing is held where there is no such folder, or its disk knows no locks."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    while Path(folder).is_dir():
        handle = os.open(folder, os.O_RDONLY)
        try:
            about = os.fstat(handle)
            key = (about.st_dev, about.st_ino, threading.get_ident())
            if key in _HELD:
                yield
                return
            with suppress(OSError):
                fcntl.flock(handle, fcntl.LOCK_EX)
            if not _is_at(about, folder):
                continue  # who held it took it away, and what stands there now is another
            _HELD.add(key)
            try:
                yield
            finally:
                _HELD.discard(key)
            return
        finally:
            os.close(handle)
    yield


def _is_at(about: os.stat_result, folder: str | os.PathLike) -> bool:
    """Whether a folder that was opened still stands where it stood."""
    try:
        return os.path.samestat(about, os.stat(folder))
    except FileNotFoundError:
        return False
