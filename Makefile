# Two commands: `make demo` and `make test`. Each creates .venv, installs what pyproject.toml and constraints.txt name, and runs.
PYTHON ?= python3
BIN := .venv/bin

demo: .venv/installed
	$(BIN)/sidestep demo -w

test: .venv/installed
	$(BIN)/ruff check .
	@$(MAKE) --no-print-directory -j2 types behaviour

types: .venv/installed
	$(BIN)/mypy

behaviour: .venv/installed
	$(BIN)/pytest -q -n auto --maxprocesses 4 --dist worksteal

.venv/installed: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Sidestep needs Python 3.11 or later; name one with make PYTHON=python3.12")'
	test -x $(BIN)/pip || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[test]'
	@touch $@

.PHONY: demo test types behaviour
