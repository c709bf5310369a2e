# make demo: plan a handover of two arms, see the timeline, get a page with the animation.
# make test: lint, formatting, types and tests.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
BUDGET ?= 10
# Processes that run tests.
WORKERS ?= $(shell nproc 2>/dev/null || echo 1)

.DEFAULT_GOAL := help
.PHONY: help demo test lint format notebooks venv clean

help:  ## say what can be made
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## */  make \1\t/' | expand -t 20

demo: $(VENV)/installed  ## plan `handover`, print the plan, write out/plan.json and out/plan.html
	$(BIN)/mrtamp plan handover --budget $(BUDGET) --out out/plan.json --html out/plan.html
	@echo
	@echo "Open out/plan.html in a browser, or run $(BIN)/mrtamp view out/plan.json"

test: lint  ## lint, formatting, types, then all tests
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile

lint: $(VENV)/installed-dev  ## ruff (lint and format) and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(VENV)/installed-dev  ## let ruff put the code in shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

notebooks: $(VENV)/installed-dev  ## run every notebook from top to bottom
	$(BIN)/jupyter execute notebooks/*.ipynb

venv: $(VENV)/installed-dev  ## create .venv with everything a developer needs

clean:  ## remove what was made here, the environment included
	rm -rf $(VENV) out build dist .pytest_cache .mypy_cache .ruff_cache .hypothesis

$(VENV)/created:
	@$(PYTHON) -c 'import sys; sys.exit("mrtamp needs Python 3.11 or newer: make PYTHON=python3.12" if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	@touch $@

# The stamps are renewed when the requirements change, not every time.
$(VENV)/installed: $(VENV)/created pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	@touch $@

$(VENV)/installed-dev: $(VENV)/created pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	@touch $@ $(VENV)/installed
