"""Files and folders that appear whole or not at all: written beside their target, then renamed."""

import ctypes
import errno
import os
import platform
import shutil
import sys
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from glob import escape
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""What a write says for which there is no room: on the disk, in one's share of it, in a file."""

HALF = ".half-"
"""What the hidden names of half-written files and folders have after the target's; the machine and the process follow."""


@contextmanager
def atomic_file(path: str | os.PathLike) -> Iterator[Path]:
    """Yield a temporary path in the target's folder, with its suffix; it becomes `path` when the block ends.

    On any exception (Ctrl-C and a full disk too) it is removed and `path` stays as it was; what a killed process left goes, too.
    Whether an existing file may be replaced is the caller's question. Raises FileNotFoundError where the target's folder does not exist.
    """
    path = Path(path)
    need_folder(path)
    handle, name = tempfile.mkstemp(prefix=_half(path, path.stem), suffix=path.suffix, dir=path.parent)
    os.close(handle)
    partial = Path(name)
    try:
        yield partial
        partial.chmod(0o666 & ~_umask())  # mkstemp's 0600 would outlive the rename
        os.replace(partial, path)
    except OSError as error:
        _name(error, partial, path)
        raise
    finally:
        partial.unlink(missing_ok=True)


def _half(path: Path, name: str) -> str:
    """How the hidden name begins by which this process writes `path`, for `name`. What processes of this machine that run no more, which
    were killed, left of the same target is taken away."""
    mine = f".{name}{HALF}{zlib.crc32(platform.node().encode()):08x}-"
    if os.name == "posix" and HALF not in str(path.parent):  # where a whole folder is being written nothing can be left of its files
        for left in path.parent.glob(f"{escape(mine)}*"):
            if not _runs(left.name.removeprefix(mine).partition("-")[0]):
                _remove(left)
    return f"{mine}{os.getpid()}-"


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def _runs(process: str) -> bool:
    """Whether a process of that number runs, as it does where nobody can tell."""
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError, ValueError):  # another user's, or no number
        return True
    return True


@contextmanager
def atomic_folder(path: str | os.PathLike, replace: bool = False) -> Iterator[Path]:
    """Yield an empty temporary folder beside the target; it becomes `path` when the block ends.

    An existing target raises FileExistsError, or with `replace` gives way once the new folder is complete. On any
    exception the temporary folder is removed and `path` stays as it was; what a killed process left goes, too.
    """
    path = Path(path)
    need_folder(path)
    if path.exists() and not replace:
        raise FileExistsError(f"{path} exists already")
    partial = Path(tempfile.mkdtemp(prefix=_half(path, path.name), dir=path.parent))
    try:
        yield partial
        partial.chmod(0o777 & ~_umask())
        if not path.exists():
            os.rename(partial, path)
        elif not _swapped(partial, path):
            old = Path(tempfile.mkdtemp(prefix=f".{path.name}.old.", dir=path.parent)) / path.name
            os.rename(path, old)
            try:
                os.rename(partial, path)
            except OSError:
                os.rename(old, path)
                raise
            finally:
                shutil.rmtree(old.parent, ignore_errors=True)
    except OSError as error:
        _name(error, partial, path)
        raise
    finally:
        _remove(partial)


def _swapped(one: Path, other: Path) -> bool:
    """Whether two names could be exchanged at one go, as Linux does on most disks (`renameat2`): no moment, for a kill to fall into, is
    without either."""
    exchange = getattr(ctypes.CDLL(None), "renameat2", None) if sys.platform == "linux" else None
    here, both = -100, 2  # AT_FDCWD, RENAME_EXCHANGE
    return exchange is not None and exchange(here, os.fsencode(one), here, os.fsencode(other), both) == 0


def _name(error: OSError, partial: Path, path: Path) -> None:
    """Raise an error, as of a full disk, anew with the name that the user knows: what stood in `partial` was to stand in `path`. Where a
    write fails, and not the opening, Python names no file; in PyAV's errors the name cannot be changed."""
    if error.filename is None and error.errno in FULL:
        raise OSError(error.errno, error.strerror, str(path)) from error
    if error.filename is not None and Path(error.filename).is_relative_to(partial):
        raise OSError(error.errno, error.strerror, str(path / Path(error.filename).relative_to(partial))) from error


def need_folder(path: Path) -> None:
    """Raise FileNotFoundError unless the folder that `path` would stand in exists, PermissionError unless it takes files, and
    NotADirectoryError where it would stand in a file."""
    _need_no_file(path.parent, path)
    if not path.parent.is_dir():
        raise FileNotFoundError(f"cannot write {path}: the folder {path.parent} does not exist; create it first")
    _need_access(path.parent, path)


def made_folder(path: Path) -> Path:
    """The folder `path`, made with those that it stands in where they are missing. PermissionError where it, or the one that it would be
    made in, takes no files; NotADirectoryError where one of them is a file."""
    _need_no_file(path, path)
    _need_access(next(folder for folder in (path, *path.absolute().parents) if folder.is_dir()), path)
    path.mkdir(parents=True, exist_ok=True)
    return path


def _need_no_file(folder: Path, path: Path) -> None:
    if (file := next((above for above in (folder, *folder.parents) if above.is_file()), None)) is not None:
        raise NotADirectoryError(f"cannot write {path}: {file} is a file, not a folder; give another name")


def _need_access(folder: Path, path: Path) -> None:
    if not os.access(folder, os.W_OK | os.X_OK):
        raise PermissionError(f"cannot write {path}: {folder.resolve()} is not writable; give a folder of your own")


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask
