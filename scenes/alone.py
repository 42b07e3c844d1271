"""One command at a time changes a folder, or writes one for hours: what it read, or has written, must not be lost to another."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

_HELD: set[tuple[int, int, int]] = set()
"""Device and number of the folders that are held, and by which thread."""

WRITTEN = "is being written by another command that runs on it; wait until it is done"
"""What is said of what `sole` holds."""


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


@contextmanager
def sole(path: str | os.PathLike) -> Iterator[None]:
    """Write a file or folder for minutes or hours, in a block: FileExistsError, at once, where another process does. A hidden empty file
    beside it, which a kill may leave, is held meanwhile. Nothing is held where no file can be made there, or the disk knows no locks."""
    try:
        import fcntl
    except ImportError:  # Windows
        yield
        return
    busy = _busy(path)
    if not os.access(busy.parent, os.W_OK | os.X_OK):  # who may write a folder that is there need not be able to make others beside it
        yield
        return
    while True:
        handle = os.open(busy, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise FileExistsError(f"{path} {WRITTEN}, stop it, or give another name with -o") from None
            except OSError:
                pass
            if not _is_at(os.fstat(handle), busy):
                continue  # who held it was done in this moment, and took it away
            try:
                yield
            finally:
                busy.unlink(missing_ok=True)
            return
        finally:
            os.close(handle)


def check_still(path: str | os.PathLike) -> None:
    """FileExistsError where another process writes a file or folder that is to be read, and holds it by `sole`."""
    busy = _busy(path)
    try:
        import fcntl

        handle = os.open(busy, os.O_RDONLY)
    except (ImportError, OSError):  # Windows; nobody does, or nobody could say so
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except BlockingIOError:
        raise FileExistsError(f"{path} {WRITTEN}, or stop it") from None
    except OSError:
        pass
    finally:
        os.close(handle)


def _busy(path: str | os.PathLike) -> Path:
    """The file that says that a file or folder is being written: beside it, also where a link leads to it."""
    whole = Path(os.path.realpath(path))
    return whole.with_name(f".{whole.name}.busy")


def _is_at(about: os.stat_result, path: str | os.PathLike) -> bool:
    """Whether a file or folder that was opened still stands where it stood."""
    try:
        return os.path.samestat(about, os.stat(path))
    except FileNotFoundError:
        return False
