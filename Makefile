# Two commands carry a newcomer: `make demo` and `make test`. Each sets everything up in .venv by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
FLINK := .flink
# What Python compiled is kept, whatever the shell says: a hundred processes of the tests read the same source.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help demo test nightly faults faults-sync flink flink-test lint types contracts wheel-check clean

help:  ## what can be made
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed 's/:.*## /\t/' | expand -t 16

$(VENV)/installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "ViAn needs Python 3.11 or newer, got $$($(PYTHON) --version). Next: make PYTHON=python3.11 $(MAKECMDGOALS)"; exit 2; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	$(BIN)/python -m pip install --quiet --editable . --group dev
	@touch $@

demo: $(VENV)/installed  ## real video to events, situations, an answer in SQL and a second log
	$(BIN)/vian demo

test: $(VENV)/installed  ## the whole test suite on a real PostgreSQL
	$(BIN)/python -m patterns.engine.compiling
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal $(PYTEST_ARGS)

nightly: $(VENV)/installed  ## 100,000 random cases of the laws of patterns
	$(BIN)/python -m patterns.engine.compiling
	VIAN_PATTERN_EXAMPLES=100000 $(BIN)/python -m pytest tests/patterns -m law --timeout 0 \
	  --numprocesses auto --dist worksteal $(PYTEST_ARGS)

faults: $(VENV)/installed  ## kills, stops, flipped bits and a full disk under load; FAULTS_ARGS="--rounds 20 --seed 1"
	$(BIN)/python -m tests.faults.campaign $(FAULTS_ARGS)

faults-sync: $(VENV)/installed  ## the same between a station and central; FAULTS_SYNC_ARGS="--rounds 20 --seed 1"
	$(BIN)/python -m tests.faults.sync_campaign $(FAULTS_SYNC_ARGS)

$(FLINK)/installed: pyproject.toml
	@java -version > /dev/null 2>&1 || { echo "Flink needs Java 17, and there is no java. Next: install a JRE"; exit 2; }
	$(PYTHON) -m venv $(FLINK)
	$(FLINK)/bin/python -m pip install --quiet --upgrade "pip>=25.1"
	$(FLINK)/bin/python -m pip install --quiet --group flink
	@touch $@

flink: $(FLINK)/installed  ## Apache Flink in an environment of its own, for flink-test and the benchmark's reference

flink-test: $(VENV)/installed $(FLINK)/installed  ## the same rows in this engine and in Flink; FLINK_ARGS="-k shipped"
	VIAN_FLINK=1 $(BIN)/python -m pytest tests/flink -s $(FLINK_ARGS)

lint: $(VENV)/installed  ## ruff, format included
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(VENV)/installed  ## mypy, strict
	$(BIN)/mypy

contracts: $(VENV)/installed  ## import contracts between the packages
	$(BIN)/lint-imports

wheel-check: $(VENV)/installed  ## the built wheel in an empty environment, run from /
	PYTHON=$(PYTHON) .ci/wheel-check

clean:  ## remove the environment and what tools left behind
	rm -rf $(VENV) $(FLINK) dist .coverage .coverage.* .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis
