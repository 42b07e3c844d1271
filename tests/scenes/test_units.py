import math
import subprocess
import sys

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scenes.units import angle, duration_us, length, speed

NUMBERS = st.floats(-1e6, 1e6, allow_nan=False)


@pytest.mark.parametrize(
    "read, text, value",
    [
        (length, "2m", 2.0),
        (length, "200cm", 2.0),
        (length, "7cm", 0.07),
        (length, "2500mm", 2.5),
        (length, "0.002km", 2.0),
        (length, "-3.5m", -3.5),
        (length, "+2m", 2.0),
        (length, " 2 m ", 2.0),
        (length, ".5m", 0.5),
        (length, "1e-1m", 0.1),
        (angle, "180deg", math.pi),
        (angle, "-0.5rad", -0.5),
        (speed, "8m/s", 8.0),
        (speed, "36km/h", 10.0),
        (duration_us, "100ms", 100_000),
        (duration_us, "2s", 2_000_000),
        (duration_us, "0.1us", 0),
        (duration_us, "1.6us", 2),
    ],
)
def test_a_quantity_reads_in_its_base_unit(read, text, value):
    assert read(text) == value
    assert type(read(text)) is type(value)


@pytest.mark.parametrize(
    "read, text, said",
    [
        (length, "2", '"2" has no unit; write 2m (metres) or 200cm'),
        (angle, "5", '"5" has no unit; write 5deg (degrees) or 0.08727rad'),
        (speed, "8", '"8" has no unit; write 8m/s or 28.8km/h'),
        (duration_us, "0.1", '"0.1" has no unit; write 0.1s (seconds) or 100ms'),
        (length, "2s", '"2s" is a time, not a length; a length is written in m, cm, mm, km, as 2m (metres) or 200cm'),
        (angle, "2m", '"2m" is a length, not an angle; an angle is written in deg, rad, as 2deg (degrees) or 0.03491rad'),
    ],
)
def test_a_missing_or_wrong_unit_is_refused_with_the_fix(read, text, said):
    with pytest.raises(ValueError) as error:
        read(text)
    assert str(error.value) == said


WRONG = ["", "m", "nanm", "infm", "-infm", "1e999m", "2 3m", "2,5m", "2m2", "2mm/s", "two m", "--2m", "2M", "0x2m", "2m\nx"]


@pytest.mark.parametrize("text", WRONG)
def test_what_is_no_finite_length_is_refused(text):
    with pytest.raises(ValueError, match="write|written"):
        length(text)


@given(NUMBERS)
def test_units_of_one_kind_agree(value):
    assert math.isclose(length(f"{value!r}m"), length(f"{value * 100!r}cm"), rel_tol=1e-14, abs_tol=1e-300)
    assert math.isclose(angle(f"{value!r}deg"), math.radians(value), rel_tol=1e-15, abs_tol=1e-300)


@given(st.text(max_size=12))
def test_any_text_is_a_number_or_a_value_error(text):
    for read in (length, angle, speed, duration_us):
        try:
            assert math.isfinite(read(text))
        except ValueError as error:
            assert len(str(error)) < 300


def test_units_load_neither_torch_nor_numpy():
    code = "import sys; from scenes.units import length; length('2m'); print('torch' in sys.modules, 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split() == ["False", "False"]
