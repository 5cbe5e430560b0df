# Everything runs in .venv inside this checkout. `make demo` and `make test` set it up first.

VENV := .venv
comma := ,
BIN := $(VENV)/bin
STAMP := $(VENV)/.setup-done
# Python compiles what is imported; compiling every file of every package takes long.
PIP := $(BIN)/python -m pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt
# pip reads the index and unpacks one package at a time; uv takes several at once and installs all pinned versions, torch
# from where pip finds it. Where uv cannot, pip does it all. Python 3.11 keeps the setuptools that it has.
INDEX := $(if $(PIP_INDEX_URL),--default-index $(PIP_INDEX_URL))
UV := $(BIN)/uv pip install --quiet --python $(BIN)/python $(INDEX) -c constraints.txt
WHEELS := $(VENV)/wheels
DOWNLOAD := $(BIN)/python -m pip download --quiet --disable-pip-version-check -c constraints.txt --no-deps -d $(WHEELS)
HAS_TORCH = ls -d $(VENV)/lib/python*/site-packages/torch-$(shell sed -n 's/^torch==//p' constraints.txt)*.dist-info >/dev/null 2>&1
# The viewer is tested in chromium, where there is one.
CHROMIUM := $(shell command -v chromium 2>/dev/null)
BROWSER := playwright greenlet
PROJECT := --no-build-isolation -e ".[dev,sim$(if $(CHROMIUM),$(comma)browser)]"
OTHERS := $(filter-out torch setuptools $(if $(CHROMIUM),,$(BROWSER)),$(shell sed -n 's/==.*//p' constraints.txt))

# The first of these that is Python 3.11 or 3.12; or say which: make setup PYTHON=/path/to/python
ifndef PYTHON
PYTHON := $(shell for p in python3 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info[:2] not in [(3, 11), (3, 12)])' >/dev/null 2>&1 && echo $$p && break; done)
endif

WORKERS ?= 2

.DEFAULT_GOAL := help
.PHONY: help setup demo test check lint format type pytest docs bench wheel clean

help:
	@echo "make demo    set up, build the Allegro contact field, generate 1,000 grasps of the sample mug"
	@echo "make test    set up, then the gate: ruff, ty, pytest"
	@echo "make setup | check | lint | format | type | pytest | docs | bench | wheel | clean"

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "lgrasp needs Python 3.11 or 3.12; give its path: make setup PYTHON=..." >&2; exit 2; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(HAS_TORCH) || $(DOWNLOAD) torch & torch=$$!; \
	$(PIP) --no-deps uv && $(UV) --no-deps $(OTHERS) || $(PIP) --no-deps $(OTHERS) && wait $$torch
	$(HAS_TORCH) || $(UV) --no-deps $(WHEELS)/torch-*.whl || $(PIP) --no-deps $(WHEELS)/torch-*.whl
	$(UV) $(PROJECT) || $(PIP) $(PROJECT)
	rm -rf $(WHEELS)
	@touch $@

demo: setup
	$(BIN)/lgrasp build-field allegro
	$(BIN)/lgrasp generate --hand allegro --object mug -n 1000 --out grasps/demo
	$(BIN)/lgrasp dataset info grasps/demo

test: check

check: lint type pytest

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

format: setup
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

type: setup
	$(BIN)/ty check --python $(VENV) --error-on-warning

# WORKERS test files run side by side, each on one thread, in their order (the longest first, few of the last are long);
# a crash ends the run. Tests start hundreds of processes: bytecode is kept.
pytest: setup
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder --max-worker-restart 0

# Pages that are made from the code: docs/reference/cli.md.
docs: setup
	PYTHONPATH=tests $(BIN)/python -m support.cli_page

bench: setup
	$(BIN)/lgrasp bench

wheel: setup
	$(BIN)/python -m hatchling build -t wheel

clean:
	rm -rf dist build .pytest_cache .ruff_cache .hypothesis grasps/demo
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
