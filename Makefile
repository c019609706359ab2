# make demo and make test set everything up by themselves; `make help` lists the rest.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= python3
BIN := .venv/bin
STAMP := .venv/.setup-done
PACKAGES := controller drivers estimation simulators

# The interpreter is the one found above; uv must never fetch another.
export UV_PYTHON_DOWNLOADS := never
UV := VIRTUAL_ENV=$(CURDIR)/.venv $(BIN)/uv
COMPILE := $(UV) pip compile --quiet --universal --fork-strategy fewest --python-version 3.11 \
	--generate-hashes --no-emit-index-url --no-header

.PHONY: help setup demo test lint fmt bench campaign coverage requirements clean

help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## /\1\t/p' Makefile | expand -t 14

setup: $(STAMP) ## create .venv with hash-checked packages

$(STAMP): pyproject.toml requirements/bootstrap.txt requirements/dev.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "truecell needs Python 3.11 or newer; name one with: make PYTHON=/path/to/python3" >&2; exit 1; }
	@echo "setup 1/3: creating .venv"
	@$(PYTHON) -m venv .venv
	@$(BIN)/python -m pip install -qq --disable-pip-version-check --require-hashes -r requirements/bootstrap.txt
	@echo "setup 2/3: installing hash-checked packages (about a minute on the first run)"
	@$(UV) pip install --quiet --compile-bytecode --require-hashes -r requirements/dev.txt
	@echo "setup 3/3: installing truecell from this folder"
	@$(UV) pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@
	@echo "setup done"

demo: $(STAMP) ## run the whole cell against simulated devices
	@$(BIN)/truecell demo

test: lint ## everything that must pass before a commit lands
	@echo "tests in virtual time"
	@$(BIN)/pytest -q -n 2 --dist loadfile --no-loadscope-reorder -m "not wire and not campaign"
	@echo "tests on real ports: alone, because they run in real time"
	@$(BIN)/pytest -q -m "wire and not campaign"

lint: $(STAMP) ## style, types and import contracts
	@echo "ruff check"
	@$(BIN)/ruff check .
	@echo "ruff format"
	@$(BIN)/ruff format --check --quiet . || { echo "run 'make fmt'" >&2; exit 1; }
	@echo "mypy --strict"
	@$(BIN)/mypy --strict $(addprefix -p ,$(PACKAGES))
	@echo "import contracts"
	@$(BIN)/lint-imports --no-logo

fmt: $(STAMP) ## format and fix what can be fixed by machine
	@$(BIN)/ruff check --fix-only --quiet .
	@$(BIN)/ruff format .

campaign: $(STAMP) ## long statistical tests
	@$(BIN)/pytest -q -n 2 -m "campaign and not wire"
	@$(BIN)/pytest -q -m "campaign and wire"
	@$(MAKE) --no-print-directory coverage

coverage: $(STAMP) ## 5,000 random cells, into docs/evidence.md
	@$(BIN)/truecell verify --cells 5000 --seed 20001 --json | $(BIN)/python docs/coverage_table.py

bench: $(STAMP) ## beside what people use today, into docs/performance.md; installs the peers
	@$(UV) pip install --quiet --require-hashes -r requirements/bench.txt
	@$(BIN)/python -m benchmarks

requirements: ## pin again after a change of dependencies in pyproject.toml; UPGRADE=--upgrade takes newer versions
	@test -x $(BIN)/uv || { $(PYTHON) -m venv .venv && $(BIN)/python -m pip install -qq --require-hashes -r requirements/bootstrap.txt; }
	@echo "uv>=0.8" | $(COMPILE) $(UPGRADE) - -o requirements/bootstrap.txt
	@$(COMPILE) $(UPGRADE) pyproject.toml -o requirements/run.txt
	@$(COMPILE) $(UPGRADE) --extra dev -c requirements/run.txt pyproject.toml -o requirements/dev.txt
	@$(COMPILE) $(UPGRADE) --extra bench -c requirements/dev.txt pyproject.toml -o requirements/bench.txt
	@if grep -nE 'https?://|file:|/home/' requirements/*.txt; then echo "a requirements file names a host or a path" >&2; exit 1; fi

clean: ## remove the environment, caches and results
	@rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis build dist
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
