"""A few of the damaged files that `python -m tests.fuzz` makes by the thousand."""

import pytest

from scenes.formats import SUFFIXES
from tests.fuzz import fuzz


@pytest.mark.parametrize("suffix", [s for s in SUFFIXES if s != ".usd"])
def test_damaged_files_are_loaded_or_refused_and_cost_no_memory(tmp_path, suffix):
    told = fuzz(suffix, 60, tmp_path, seed=1)
    assert not told.others and told.refused > 20
    assert told.mib < 300
