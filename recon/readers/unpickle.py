"""Reads pickled pandas frames without running foreign code and without pandas.

A pickle is a program. This unpickler knows a short list of numpy names, which rebuild arrays, and answers every pandas
name with an inert record of its arguments; any other name is refused. The columns are then picked out of the records, so
that frames written by pandas 0.23 to 3 read alike, whichever pandas is installed here.
"""

from __future__ import annotations

import gzip
import io
import pickle
import zlib
from pathlib import Path

import numpy as np

NUMPY_NAMES = {
    (f"numpy.{core}.{module}", name)
    for core in ("core", "_core")
    for module, name in (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"))
} | {("numpy", "ndarray"), ("numpy", "dtype"), ("builtins", "slice")}


class Record:
    """What stands in for a pandas object: its arguments and its state, and nothing that runs."""

    args: tuple = ()
    state: object = None

    def __new__(cls, *args, **_kwargs):
        self = object.__new__(cls)
        self.args = args
        return self

    def __init__(self, *args, **kwargs):
        pass

    def __setstate__(self, state):
        self.state = state


class RestrictedUnpickler(pickle.Unpickler):
    """Admits numpy's array constructors, `slice`, and pandas names as inert records."""

    def find_class(self, module: str, name: str):
        if (module, name) in NUMPY_NAMES:
            return super().find_class(module, name)
        if module.split(".")[0] == "pandas" and name.isidentifier():
            return type(name, (Record,), {})
        raise pickle.UnpicklingError(f"it asks for {module}.{name}, and only pandas and numpy data are admitted")

    def persistent_load(self, _pid):
        raise pickle.UnpicklingError("it refers to objects outside the file")


def read_frame(path: str | Path) -> dict[str, np.ndarray]:
    """Columns by name, each `[rows]`, of a pickled pandas DataFrame (`.pkl`, `.pkl.gz`).

    Raises ValueError naming the file where it is not one, is cut off, or asks for any name but pandas' and numpy's.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
        if data[:2] == b"\x1f\x8b":
            data = gzip.decompress(data)
        frame = RestrictedUnpickler(io.BytesIO(data)).load()
        return _columns(frame)
    except FileNotFoundError:
        raise
    except pickle.UnpicklingError as problem:
        raise ValueError(f"{path} is not read: {problem}") from None
    except (EOFError, gzip.BadGzipFile, zlib.error) as problem:
        raise ValueError(f"{path} is cut off or corrupt ({problem}); fetch the file again") from None
    except (AttributeError, LookupError, TypeError, ValueError, ImportError, MemoryError, OverflowError, RecursionError) as problem:
        raise ValueError(f"{path} does not hold a pandas table ({type(problem).__name__}: {problem})") from None


def _columns(frame) -> dict[str, np.ndarray]:
    if type(frame).__name__ != "DataFrame" or not isinstance(frame.state, dict):
        raise ValueError(f"expected a DataFrame, found {type(frame).__name__}")
    manager = frame.state["_mgr"] if "_mgr" in frame.state else frame.state["_data"]
    if manager.args:  # pandas 1.3 and later: BlockManager(blocks, axes)
        blocks, axes = manager.args
        pieces = [(block.args[0], block.args[1]) for block in blocks]
    else:  # before: a state tuple whose last entry says it all
        named = manager.state[3]["0.14.1"]
        axes, pieces = named["axes"], [(b["values"], b["mgr_locs"]) for b in named["blocks"]]
    names = [str(n) for n in _values(axes[0])]
    columns: dict[str, np.ndarray] = {}
    for values, where in pieces:
        values = np.atleast_2d(_values(values))
        places = range(len(names))[where] if isinstance(where, slice) else [int(i) for i in _values(where)]
        if len(places) != len(values):
            raise ValueError(f"a block of {len(values)} rows stands at {len(places)} columns")
        for place, row in zip(places, values, strict=True):
            columns[names[place]] = row
    if len(columns) != len(names) or len({len(c) for c in columns.values()}) > 1:
        raise ValueError("its columns are not all there, or differ in length")
    return {name: columns[name] for name in names}


def _values(thing) -> np.ndarray:
    """The array inside an index or an extension array's record."""
    if isinstance(thing, np.ndarray):
        return thing
    if isinstance(thing, Record):
        return _values((thing.args, thing.state))
    inside = thing.values() if isinstance(thing, dict) else thing if isinstance(thing, (tuple, list)) else ()
    for part in inside:
        if isinstance(part, (np.ndarray, Record, dict, tuple, list)):
            try:
                return _values(part)
            except ValueError:
                continue
    raise ValueError(f"no array in a {type(thing).__name__}")
