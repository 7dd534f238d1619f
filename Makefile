# The commands of the project. They need Linux, make and Python 3.11 or newer with pip; everything else is installed, into the
# active virtual environment or, without one, into .venv.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-builtin-rules --no-print-directory

SAMPLE ?= tests/data/kitti_06_first51
OUT ?= out/kitti_06_first51
ARGS ?=
PYTEST_ARGS ?=

# Without an active environment: the newest python that is new enough makes .venv.
PYTHON ?= $(shell for name in python3.14 python3.13 python3.12 python3.11 python3 python; do \
	if command -v $$name >/dev/null && $$name -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; \
	then echo $$name; break; fi; done)

ENVIRONMENT := $(if $(VIRTUAL_ENV),$(VIRTUAL_ENV),$(CURDIR)/.venv)
BIN := $(ENVIRONMENT)/bin
export PATH := $(BIN):$(PATH)
export VIRTUAL_ENV := $(ENVIRONMENT)

# What is installed is written down inside the environment: it goes with it, and a second `make` installs nothing. An
# environment that serves another checkout is installed anew, for an editable installation points into one checkout.
STAMP := $(ENVIRONMENT)/.vggt-motion
RUNTIME := $(STAMP)-runtime
DEV := $(STAMP)-dev
ifneq ($(shell cat '$(STAMP)-checkout' 2>/dev/null),$(CURDIR))
$(shell rm -f '$(RUNTIME)' '$(DEV)')
endif
PIP_INSTALL := $(BIN)/python -m pip install -qq --disable-pip-version-check --no-input --retries 5

.PHONY: help
help: ## Show the commands
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1|\2/p' Makefile | while IFS='|' read -r name what; do printf '%-22s%s\n' "$$name" "$$what"; done

$(BIN)/python:
	@if [ -z '$(PYTHON)' ]; then \
		echo 'No Python 3.11 or newer with venv found: install one (Debian: python3-venv), or activate a virtual environment.' >&2; exit 2; fi
	@echo "Making the virtual environment $(ENVIRONMENT) with $(PYTHON)"
	@$(PYTHON) -m venv '$(ENVIRONMENT)'

$(RUNTIME): pyproject.toml | $(BIN)/python
	@$(BIN)/python -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo '$(ENVIRONMENT) has a Python older than 3.11' >&2; exit 2; }
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip >/dev/null
	@echo 'Installing vggt-motion into $(ENVIRONMENT) (a minute or two, once)'
	@$(PIP_INSTALL) --editable .
	@printf '%s' '$(CURDIR)' > '$(STAMP)-checkout'
	@touch '$@'

$(DEV): pyproject.toml $(RUNTIME)
	@echo 'Installing what the checks need into $(ENVIRONMENT)'
	@$(PIP_INSTALL) --editable '.[dev]'
	@touch '$@'

.PHONY: install
install: $(RUNTIME) ## Install the command into the active environment, or .venv

.PHONY: run
run: $(RUNTIME) ## Run the sample of the repository through all services
	vggt-motion run '$(SAMPLE)' --out '$(OUT)' --ground-truth '$(SAMPLE)/poses.txt' $(ARGS)

.PHONY: lint
lint: $(DEV) ## Check style, types and the wire contract
	ruff check .
	ruff format --check .
	mypy
	buf lint

.PHONY: test
test: lint ## Run the checks and all tests but the long ones
	pytest -m 'not slow and not faults' $(PYTEST_ARGS)

.PHONY: test-slow
test-slow: $(DEV) ## Run the slow tests
	pytest -m slow $(PYTEST_ARGS)

.PHONY: test-faults
test-faults: $(DEV) ## Kill, freeze, cut and fill up the services for an hour
	pytest -m faults $(PYTEST_ARGS)

.PHONY: proto
proto: $(DEV) ## Generate the code of the wire contract
	python proto/generate.py

.PHONY: bench
bench: $(DEV) ## Run every benchmark
	@shopt -s nullglob; found=0; \
	for file in tests/benchmarks/bench_*.py; do found=1; echo "== $$file"; python "$$file"; done; \
	[ $$found -eq 1 ] || { echo 'no benchmark in tests/benchmarks' >&2; exit 1; }

.PHONY: clean
clean: ## Remove results, build leftovers and caches; environments stay
	rm -rf out build dist .mypy_cache .ruff_cache .pytest_cache .hypothesis .coverage services/*.egg-info
	find services tests proto -name __pycache__ -type d -prune -exec rm -rf {} +
