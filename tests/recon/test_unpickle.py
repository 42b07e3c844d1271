import gzip
import os
import pickle

import numpy as np
import pandas as pd
import pytest
from made_drive import pickle_frame

from recon.readers.unpickle import read_frame


class Malicious:
    def __init__(self, call, *args):
        self.call, self.args = call, args

    def __reduce__(self):
        return self.call, self.args


def test_a_frame_written_by_this_pandas_reads_as_written(tmp_path):
    frame = {"x": [1.5, 2.5], "name": ["a", "b"], "still": [True, False], "n": [1, 2]}
    pickle_frame(frame, tmp_path / "f.pkl.gz")
    read = read_frame(tmp_path / "f.pkl.gz")
    assert {name: column.tolist() for name, column in read.items()} == frame


def test_a_frame_in_the_old_block_layout_reads_too(tmp_path):
    """As pandas before 1.3 pickled it: a manager without arguments and a state of four."""
    values, names = np.arange(6.0).reshape(2, 3), np.array(["x", "y"], dtype=object)

    def state_of(kind, state):
        holder = type(kind, (), {"__reduce__": lambda self: (type(self), (), state)})
        holder.__module__, holder.__qualname__ = "pandas.made_up", kind
        return holder

    import sys
    import types

    module = types.ModuleType("pandas.made_up")
    block = {"values": values, "mgr_locs": slice(0, 2, 1)}
    manager_state = ([names, np.arange(3)], [values], [names], {"0.14.1": {"axes": [names], "blocks": [block]}})
    module.BlockManager = state_of("BlockManager", manager_state)
    module.DataFrame = state_of("DataFrame", {"_data": module.BlockManager()})
    sys.modules["pandas.made_up"] = module
    try:
        (tmp_path / "f.pkl").write_bytes(pickle.dumps(module.DataFrame()))
    finally:
        del sys.modules["pandas.made_up"]
    read = read_frame(tmp_path / "f.pkl")
    assert read["x"].tolist() == [0, 1, 2] and read["y"].tolist() == [3, 4, 5]


@pytest.mark.parametrize(
    "call, args", [(os.system, ("true",)), (eval, ("1",)), (pd.read_pickle, ("x",)), (getattr, ("a", "upper")), (pd.eval, ("1+1",))]
)
def test_a_pickle_that_calls_anything_foreign_is_refused_and_runs_nothing(tmp_path, call, args):
    file = tmp_path / "evil.pkl.gz"
    file.write_bytes(gzip.compress(pickle.dumps(Malicious(call, *args))))
    with pytest.raises(ValueError, match="evil.pkl.gz"):
        read_frame(file)


def test_pandas_code_is_never_called(tmp_path, monkeypatch):
    """pandas names are answered with records: even a pickle that reduces to a pandas function does not run it."""
    ran = []
    monkeypatch.setattr(pd, "eval", lambda *a: ran.append(a))
    file = tmp_path / "evil.pkl"
    file.write_bytes(b"cpandas\neval\n(V1+1\ntR.")
    with pytest.raises(ValueError, match="evil.pkl"):
        read_frame(file)
    assert not ran


@pytest.mark.parametrize("keep", [0, 10, 200, -5])
def test_a_cut_off_file_is_named(tmp_path, keep):
    file = tmp_path / "cut.pkl.gz"
    pickle_frame({"x": np.arange(100.0)}, file)
    file.write_bytes(file.read_bytes()[:keep])
    with pytest.raises(ValueError, match="cut.pkl.gz"):
        read_frame(file)


def test_a_missing_file_is_a_missing_file(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_frame(tmp_path / "none.pkl.gz")


def test_something_else_than_a_table_is_said(tmp_path):
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1, 2]))
    with pytest.raises(ValueError, match="does not hold a pandas table"):
        read_frame(tmp_path / "list.pkl")


def test_old_and_new_pickles_of_the_real_drive_read_as_pandas_reads_them(pandaset):
    for name in ("lidar/00.pkl.gz", "lidar/40.pkl.gz", "annotations/cuboids/07.pkl.gz"):
        ours, theirs = read_frame(pandaset / name), pd.read_pickle(pandaset / name)
        assert list(ours) == list(theirs.columns)
        for column in ours:
            same = pd.Series(ours[column]).astype(object).fillna("") == theirs[column].astype(object).fillna("").to_numpy()
            assert same.all()
