PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help setup search test test-all lint types clean

help:
	@echo "make search   set up, fetch the default detector, search the embedded scenes, write tables and pictures"
	@echo "make test     set up, then lint, types and tests"
	@echo "make test-all the same, with the tests that take minutes"
	@echo "make clean    remove the environment and run outputs"

setup: $(STAMP)

$(STAMP): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --editable ".[dev]"
	@touch $@

search: $(STAMP)
	$(BIN)/python -m eval.search

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

test: lint types
	$(BIN)/python -m pytest -n 2

test-all: lint types
	$(BIN)/python -m pytest -n 2 -m ""

clean:
	rm -rf $(VENV) runs
