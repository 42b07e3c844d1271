"""Arrow tables (feather and parquet files) as plain columns; the only module that imports pyarrow."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

FIX = "it is read by pyarrow, which is not installed; get it with: pip install 'sidestep[arrow]'"


def read_table(path: Path, columns: Sequence[str], others: bool = True, rows: tuple[str, Any] | None = None) -> dict[str, np.ndarray]:
    """Columns by name, each `[rows]`, of a .feather or .parquet file, which must have `columns`.

    others: read the file's other columns too. rows: only those where a column has a value, as ("key.camera_name", 1).
    FileNotFoundError; ValueError naming file and column where one is missing, the file is cut off, or pyarrow is not installed.
    """
    if not path.is_file():
        raise FileNotFoundError(f"{path} is missing; the data set's layout has it")
    _check_installed(path)
    from pyarrow import ArrowInvalid, feather, parquet

    try:
        if path.suffix == ".parquet":
            have = parquet.read_schema(path).names
            _check(path, columns, have)
            table = parquet.read_table(path, columns=None if others else list(columns), filters=rows and [(rows[0], "=", rows[1])])
        else:
            table = feather.read_table(path, memory_map=False)
            _check(path, columns, table.column_names)
    except (ArrowInvalid, OSError) as problem:
        raise ValueError(f"{path} is cut off or corrupt ({str(problem).splitlines()[0][:120]}); fetch it again") from None
    return {name: table.column(name).to_numpy() for name in table.column_names if others or name in columns}


def read_cell(path: Path, column: str, row: int) -> Any:
    """One value of a .parquet file, with its row group alone: a file of pictures is larger than what one wants to hold."""
    _check_installed(path)
    from pyarrow import ArrowInvalid, parquet

    try:
        with parquet.ParquetFile(path) as file:
            for group in range(file.num_row_groups):
                count = file.metadata.row_group(group).num_rows
                if row < count:
                    return file.read_row_group(group, columns=[column]).column(0)[row].as_py()
                row -= count
    except (ArrowInvalid, OSError) as problem:
        raise ValueError(f"{path} is cut off or corrupt ({str(problem).splitlines()[0][:120]}); fetch it again") from None
    raise ValueError(f"{path} ends {row + 1} rows early; fetch it again")


def _check_installed(path: Path) -> None:
    try:
        import pyarrow  # noqa: F401
    except ModuleNotFoundError:
        raise ValueError(f"{path}: {FIX}") from None


def _check(path: Path, wanted: Sequence[str], have: Sequence[str]) -> None:
    lost = next((name for name in wanted if name not in have), None)
    if lost is not None:
        raise ValueError(f'{path} has no column "{lost}"; it has {", ".join(have)}')
