"""The table of hazards, printed once at the end: its rows travel on the tests' reports, whichever process ran them."""

from dataclasses import asdict

import pytest

ROW = "hazard"


@pytest.fixture
def keep_row(record_property):
    return lambda name, outcome: record_property(ROW, (name, asdict(outcome)))


def pytest_terminal_summary(terminalreporter):
    from tests.stress.hazards import Outcome, table

    reports = [r for outcome in ("passed", "failed") for r in terminalreporter.getreports(outcome)]
    rows = sorted(row for r in reports for key, row in r.user_properties if key == ROW)
    if rows:
        terminalreporter.section("hazards")
        terminalreporter.write_line(table({name: Outcome(**fields) for name, fields in rows}))
