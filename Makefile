# Two commands: `make run` (train on the paper's first problem) and `make test` (all tests).
PYTHON ?= python3
BIN := .venv/bin
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c
# Python must not import from this folder by chance (loop_interfaces/module_path.py).
export PYTHONSAFEPATH := 1
# What hundreds of processes import is compiled once, also where the environment says otherwise.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup run test coverage packages lint types docs check lock audit clean

setup: .venv/ready

# A virtual environment with pinned versions, updated when the pins change: first the packages that running
# needs, then those of the tests. Each archive must have one of the digests in requirements/. Bytecode is
# compiled at the first import.
PIP := $(BIN)/python -m pip --disable-pip-version-check
install = $(PIP) install --no-compile --require-hashes -r requirements/$(1).txt \
	| sed -un 's/^Collecting \([^ ]*\).*/  \1/p; s/^Installing collected.*/  installing/p'

.venv/runs: pyproject.toml requirements/run.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "pdeloop needs Python 3.11 or newer; set PYTHON=/path/to/python3" >&2; exit 1; }
	@test -d .venv || echo "setting up .venv, once: Python packages and ROS 2"
	@test -d .venv || $(PYTHON) -m venv .venv
	@$(call install,run)
	@$(PIP) install --quiet --no-deps --no-build-isolation -e .
	@touch $@

.venv/ready: .venv/runs requirements/test.txt
	@echo "setting up .venv for tests, once"
	@$(call install,test)
	@touch $@

# uv writes the digests, pip-audit asks for advisories; pdeloop itself needs neither.
.venv/supply:
	@test -d .venv || $(PYTHON) -m venv .venv
	@$(PYTHON) -m venv .venv/supply.new
	@.venv/supply.new/bin/python -m pip install -qq --disable-pip-version-check uv==0.13.9 pip-audit==2.10.1
	@mv .venv/supply.new $@

# The digests of all archives of the pinned versions; a version is changed in constraints.txt. With its extras,
# since pip holds name[extra], which a package asks for, to the pin of name[extra] alone.
lock: .venv/supply
	@for part in run:ros,report test:ros,dev; do \
		echo setuptools | .venv/supply/bin/python -m uv pip compile --quiet --universal --generate-hashes --no-strip-extras \
			--no-annotate --no-header --constraint constraints.txt $$(echo $${part#*:} | tr , '\n' | sed 's/^/--extra /') \
			--output-file requirements/$${part%:*}.txt pyproject.toml - || exit 1; \
		sed -i "s/ ; python_full_version >= '3.11.5' and python_full_version < '3.15' and sys_platform == 'linux'//" \
			requirements/$${part%:*}.txt; \
	done

# Which of the pinned versions are no longer the newest, and which have known vulnerabilities.
audit: setup .venv/supply
	@$(PIP) list --outdated
	@.venv/supply/bin/python -m pip_audit --requirement requirements/test.txt --require-hashes --disable-pip \
		--progress-spinner off

run: .venv/runs
	$(BIN)/pdeloop train burgers

# Five workers for two cores: tests over topics spend part of their time waiting. Each has a ROS domain of its own.
# Further threads of linear algebra would spin in every process.
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 5 --dist worksteal

# All tests, each of them once; with COVERAGE=1, those without topics are run by `coverage`.
test: setup packages $(if $(COVERAGE),coverage)
	$(PYTEST) $(if $(COVERAGE),-m topics)

# The tests without topics, with their coverage of the pure modules (pyproject.toml).
coverage: setup packages
	$(PYTEST) -m "not topics" -p pytest_cov --cov

# Debian's packages that tests need: a real browser for the report's page, faketime to make a clock
# jump, iproute2 for hosts made of network namespaces, a C compiler for exported laws, zsh and fish for
# their completion. Other distributions lack some of them (Ubuntu: chromium): those tests are skipped and say so.
packages:
	@missing=(); \
	command -v chromium >/dev/null || missing+=(chromium); \
	command -v cc >/dev/null || missing+=(gcc libc6-dev); \
	command -v ip >/dev/null || missing+=(iproute2); \
	for shell in zsh fish; do command -v $$shell >/dev/null || missing+=($$shell); done; \
	ls /usr/lib/*/faketime/libfaketime.so.1 >/dev/null 2>&1 || missing+=(faketime); \
	if [ $${#missing[@]} != 0 ] && [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && apt-get update -qq; then \
		wanted=("$${missing[@]}"); missing=(); \
		for name in "$${wanted[@]}"; do \
			apt-get install -y -qq --no-install-recommends $$name >/dev/null || missing+=($$name); \
		done; \
	fi; \
	if [ $${#missing[@]} != 0 ]; then \
		echo "not installed: $${missing[*]} (Debian's names): some tests will be skipped" >&2; \
	fi

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/mypy

# The site of all documents and of the Python API, in site/; warnings are errors.
docs: setup
	$(BIN)/mkdocs build --strict --quiet

check: test lint types docs

clean:
	rm -rf .venv build site *.egg-info .pytest_cache .mypy_cache .ruff_cache
