# Two commands: `make run` (train on the paper's first problem) and `make test` (all tests).
PYTHON ?= python3
BIN := .venv/bin
SHELL := /bin/bash
.SHELLFLAGS := -o pipefail -c
# Python must not import from this folder by chance (pdeloop/process/module_path.py).
export PYTHONSAFEPATH := 1
# What hundreds of processes import is compiled once, also where the environment says otherwise.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: setup run test test-extras test-neighbours findings coverage packages lint types docs check lock audit clean

setup: .venv/ready

# A virtual environment with pinned versions, updated when the pins change: first the packages that running
# needs, then those of the tests. Each archive must have one of the digests in requirements/. Bytecode is
# compiled at the first import.
PIP := $(BIN)/python -m pip --disable-pip-version-check
# Faster than pip; from the index that pip is told of.
UV := UV_DEFAULT_INDEX=$${UV_DEFAULT_INDEX:-$${PIP_INDEX_URL:-$$($(PIP) config get global.index-url 2>/dev/null)}} \
	$(BIN)/python -m uv
# pip knows more ways to an index (find-links, several indices): it tries where uv has failed.
install = { $(UV) pip install --python $(BIN)/python --require-hashes -r requirements/$(1).txt 2>&1 \
		| sed -u '/^ [-+~] /d; /Downloaded/d; /Buil[dt]/d' || { echo "installing with pip instead" && \
		$(PIP) install --quiet --no-compile --require-hashes -r requirements/$(1).txt; }; } >&2

.venv/uv: requirements/uv.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "pdeloop needs Python 3.11 or newer; set PYTHON=/path/to/python3" >&2; exit 1; }
	@test -d .venv || echo "setting up .venv, once: Python packages and ROS 2"
	@test -d .venv || $(PYTHON) -m venv .venv
	@$(PIP) install --quiet --no-compile --require-hashes -r requirements/uv.txt || echo "there is no uv" >&2
	@touch $@

.venv/runs: .venv/uv pyproject.toml requirements/run.txt
	@$(call install,run)
	@own="--quiet --no-deps --no-build-isolation -e ."; \
		$(UV) pip install --python $(BIN)/python $$own 2>/dev/null || $(PIP) install $$own
	@touch $@

.venv/ready: .venv/runs requirements/test.txt
	@echo "setting up .venv for tests, once"
	@$(call install,test)
	@touch $@

# The digests of all archives of the pinned versions; a version is changed in constraints.txt. With its extras,
# since pip holds name[extra], which a package asks for, to the pin of name[extra] alone.
lock: .venv/uv
	@for part in uv: run:ros,report,record,monitor test:ros,dev; do \
		extras=$${part#*:}; { if [ $$extras ]; then echo setuptools; else echo uv; fi; } \
			| $(UV) pip compile --quiet --universal --generate-hashes --no-strip-extras \
			--no-annotate --no-header --constraint constraints.txt $$(echo $$extras | tr , '\n' | sed 's/./--extra &/') \
			--output-file requirements/$${part%:*}.txt $${extras:+pyproject.toml} - || exit 1; \
		sed -i "s/ ; python_full_version >= '3.11.5' and python_full_version < '3.15' and sys_platform == 'linux'//" \
			requirements/$${part%:*}.txt; \
	done

# Which of the pinned versions are no longer the newest, and which have known vulnerabilities.
audit: setup
	@$(PIP) list --outdated
	@$(UV) tool run pip-audit==2.10.1 --requirement requirements/test.txt --require-hashes --disable-pip \
		--progress-spinner off

run: .venv/runs
	$(BIN)/pdeloop train burgers

# Four workers for two cores: tests over topics spend part of their time waiting. Each has a ROS domain of its own,
# and takes ten seconds of a core to import and collect the tests.
# Further threads of linear algebra would spin in every process.
PYTEST := OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -n 4 --dist worksteal

# All tests, each of them once; with COVERAGE=1, those without topics are run by `coverage`.
test: setup packages $(if $(COVERAGE),coverage)
	$(PYTEST) $(if $(COVERAGE),-m topics)

# The tests of the extras that are not in `dev`, which are large or for few: installed here, without digests.
test-extras: setup packages
	@$(PIP) install --quiet -c constraints.txt -e '.[extras]'
	$(PYTEST) $(EXTRAS)

EXTRAS := $(addprefix tests/plant/test_,fmu.py cell.py tokamak.py) \
	$(addprefix tests/tools/test_,data_sets.py logs.py model_files.py stable_baselines.py tensorboard.py warm_start.py) \
	tests/method/test_neural.py::test_it_is_trained_evaluated_and_exported \
	tests/benchmarks/test_baselines.py::test_agents_pay_for_each_rollout_and_are_functions_of_the_seed

# The libraries of docs/neighbours.md, pinned, against ours.
test-neighbours: setup
	@$(PIP) install --quiet -c constraints.txt -e '.[neighbours]'
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest tests/neighbours

# What other software does that a guess would not expect; each script says what, and which have changed is printed.
findings:
	@changed=0; for script in findings/*.sh; do \
		if bash $$script >/dev/null 2>&1; then echo "as before  $$script"; else echo "CHANGED    $$script"; changed=1; fi; \
	done; exit $$changed

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
