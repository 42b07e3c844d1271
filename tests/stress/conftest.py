"""The table of hazards, printed once at the end."""

import pytest

TABLE: dict = {}


@pytest.fixture(scope="session")
def hazard_table():
    return TABLE


def pytest_terminal_summary(terminalreporter):
    if TABLE:
        from tests.stress.hazards import table

        terminalreporter.section("hazards")
        terminalreporter.write_line(table(TABLE))
