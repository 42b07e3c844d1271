"""Arrow tables (feather and parquet files) as plain columns; the only module that imports pyarrow."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

PIECE = 16
"""Rows of range images that are unpacked at once."""
FIX = "it is read by pyarrow, which is not installed; get it with: pip install 'sidestep[arrow]'"


def read_table(path: Path, columns: Sequence[str], others: bool = True) -> dict[str, np.ndarray]:
    """Columns by name, each `[rows]`, of a .feather or .parquet file, which must have `columns`.

    others: read the file's other columns too.
    FileNotFoundError; ValueError naming file and column where one is missing, the file is cut off, or pyarrow is not installed.
    """
    with _opening(path):
        from pyarrow import feather, parquet

        if path.suffix == ".parquet":
            _check(path, columns, parquet.read_schema(path).names)
            table = parquet.read_table(path, columns=None if others else list(columns))
        else:
            table = feather.read_table(path, memory_map=False)
            _check(path, columns, table.column_names)
    return {name: table.column(name).to_numpy() for name in table.column_names if others or name in columns}


class Rows:
    """Rows of a .parquet file by what a column of it says, a sweep's by its stamp: `read` asks for those of one value.

    A file of range images unpacks to gigabytes, and by row groups only. The last group is kept as Arrow has it, so that those who read in
    the file's order unpack each once.
    """

    def __init__(self, path: Path, key: str, columns: Sequence[str]):
        self.path, self.key, self.columns = path, key, list(columns)
        self._kept: tuple[Any, Any] = None, None

    def read(self, value: int) -> dict[str, np.ndarray]:
        """The columns by name, each `[rows]`, of the rows where the key column has a value. Raises as `read_table` does."""
        with _opening(self.path):
            import pyarrow
            from pyarrow import parquet

            with parquet.ParquetFile(self.path) as file:
                _check(self.path, (self.key, *self.columns), file.schema_arrow.names)
                parts, first = [file.schema_arrow.empty_table().select(self.columns)], 0
                mine = np.flatnonzero(file.read([self.key]).column(0).to_numpy() == value)
                for group in range(file.num_row_groups):
                    count = file.metadata.row_group(group).num_rows
                    within = mine[(first <= mine) & (mine < first + count)] - first
                    if len(within):
                        kept = self._group(file, group)
                        parts += [kept.slice(row, 1) for row in within.tolist()]
                    first += count
            table = pyarrow.concat_tables(parts)
        return {name: table.column(name).to_numpy() for name in self.columns}

    def _group(self, file, group: int):
        import pyarrow

        about = self.path.stat()
        wanted = group, about.st_size, about.st_mtime_ns  # of the file as it is now
        if self._kept[0] != wanted:
            self._kept = None, None  # two at once would be twice the memory, as would be a group in one piece
            pieces = list(file.iter_batches(PIECE, row_groups=[group], columns=self.columns))
            self._kept = wanted, pyarrow.Table.from_batches(pieces).select(self.columns)
        return self._kept[1]


def read_cell(path: Path, column: str, row: int) -> Any:
    """One value of a .parquet file, with its row group alone: a file of pictures is larger than what one wants to hold."""
    with _opening(path):
        from pyarrow import parquet

        with parquet.ParquetFile(path) as file:
            for group in range(file.num_row_groups):
                count = file.metadata.row_group(group).num_rows
                if row < count:
                    return file.read_row_group(group, columns=[column]).column(0)[row].as_py()
                row -= count
    raise ValueError(f"{path} ends {row + 1} rows early; fetch it again")


@contextmanager
def _opening(path: Path) -> Iterator[None]:
    """Around what reads a file: FileNotFoundError where it is missing, ValueError where it is cut off or pyarrow is not installed."""
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; the data set's layout has it")
    try:
        from pyarrow import ArrowInvalid
    except ModuleNotFoundError:
        raise ValueError(f"{path}: {FIX}") from None
    try:
        yield
    except (ArrowInvalid, OSError) as problem:
        raise ValueError(f"{path} is cut off or corrupt ({str(problem).splitlines()[0][:120]}); fetch it again") from None


def _check(path: Path, wanted: Sequence[str], have: Sequence[str]) -> None:
    lost = next((name for name in wanted if name not in have), None)
    if lost is not None:
        raise ValueError(f'{path} has no column "{lost}"; it has {", ".join(have)}')
