# One line a target: `make help`. Everything runs in $(VENV), which each target sets up by itself.
PYTHON ?= python3
VENV   ?= .venv
ARGS   ?=
SYSTEM ?= yes
ABLATION ?= normals
BIN    := $(VENV)/bin
STAMP  := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help setup check test nightly coverage train sweep board bench docs clean

help:   ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## /{printf "  make %-10s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo 'ARGS="key=value ..." is passed on: make train ARGS="model=pnu_paper loss.w3=0.1"'

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(0 if (3, 11) <= sys.version_info < (3, 15) else "pnu needs Python 3.11 to 3.14, $(PYTHON) is " + sys.version.split()[0] + ": make PYTHON=python3.12 ...")'
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { echo 'Python lacks venv; on Debian: apt-get install python3-venv'; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@$(BIN)/pnu doctor --install $(if $(filter no,$(SYSTEM)),--no-system)
	@touch $@

setup: $(STAMP)   ## virtual environment in .venv, pinned packages, pnu itself, system libraries (SYSTEM=no: none), compiled kernels

check: $(STAMP)   ## lint, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: $(STAMP)   ## the test suite (minutes); the slow ones: nightly
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto $(ARGS)

nightly: $(STAMP)   ## the slow tests from start to end and a summary: kill -9, several processes, fuzzing, documented commands (an hour or two)
	OMP_NUM_THREADS=1 $(BIN)/python -m tests.nightly $(ARGS)

coverage: $(STAMP)   ## the test suite, and which lines of pnu/ it does not reach
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --cov=pnu $(ARGS)

train: $(STAMP)   ## train the paper's network on embedded data: a small success in minutes
	$(BIN)/python -m pnu.train experiment=quickstart $(ARGS)

sweep: $(STAMP)   ## a small ablation and its report in minutes: make sweep ABLATION=loss_terms
	$(BIN)/python -m pnu.train -m ablation=$(ABLATION) scale=small hydra/launcher=joblib hydra.launcher.n_jobs=2 $(ARGS)
	$(BIN)/pnu report

board: $(STAMP)   ## TensorBoard over outputs/
	@$(BIN)/pnu doctor --require
	$(BIN)/tensorboard --logdir outputs $(ARGS)

bench: $(STAMP)   ## measure speed, as ratios to named alternatives; fails where one is 10 % worse than committed
	$(BIN)/python -m bench $(ARGS)

docs: $(STAMP)   ## the documentation as a site, in build/docs; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

clean:   ## remove caches and the virtual environment; data/ and outputs/ stay
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
