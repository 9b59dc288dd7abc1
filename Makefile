# Two commands: `make run` (train on the paper's first problem) and `make test` (all tests).
PYTHON ?= python3
BIN := .venv/bin
SHELL := /bin/bash

.PHONY: setup run test chromium lint types check clean

setup: .venv/ready

# A fresh virtual environment with pinned versions; made again when the pins change.
.venv/ready: pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "pdeloop needs Python 3.11 or newer; set PYTHON=/path/to/python3" >&2; exit 1; }
	test -d .venv || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[ros,dev]'
	touch $@

run: setup
	$(BIN)/pdeloop train burgers

# Two workers; each test over topics has a ROS domain of its own.
test: setup chromium
	$(BIN)/python -m pytest -n 2 --dist worksteal

# The report's page is tested in a real browser. Where it cannot be had, that test says so.
chromium:
	@command -v chromium >/dev/null || { test "$$(id -u)" = 0 && command -v apt-get >/dev/null \
		&& { apt-get update -qq; apt-get install -y -qq --no-install-recommends chromium >/dev/null; }; } \
		|| echo "chromium is not installed (Debian's package chromium): a test will fail without it" >&2

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/mypy

check: test lint types

clean:
	rm -rf .venv build *.egg-info .pytest_cache .mypy_cache .ruff_cache
