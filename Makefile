PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# The tests of a file stay together: what they share is made once.
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# Tests are rewritten and start many processes: bytecode that is kept halves the time to collect them.
unexport PYTHONDONTWRITEBYTECODE

NUMERIC := tests/belief tests/decision tests/observation tests/sensor \
	$(patsubst %,tests/head/test_%.py,belief modules world) \
	$(patsubst %,tests/zoom/test_%.py,belief certainty modules networks survey)

.DEFAULT_GOAL := help
.PHONY: help setup search test numeric lab test-all test-quick gpu coverage mutation docs lint types constraints clean

help:
	@echo "make search      set up, fetch the default detector, search the embedded scenes, write tables and pictures"
	@echo "make test        set up, then lint, types and the tests of the library"
	@echo "make lab         the tests of studies, fits for studies, benchmarks and the site"
	@echo "make test-quick  the tests that take no more than a second each"
	@echo "make test-all    all of these, with the tests that repeat others at length"
	@echo "make gpu         on a machine with a GPU: the tests that use one, and a page of benchmarks"
	@echo "make coverage    the tests, and which lines and branches they reach"
	@echo "make mutation    change the library's formulas one by one, and list the changes that no test notices (hours)"
	@echo "make docs        set up, then build the site in build/site"
	@echo "make constraints write the versions of this environment down as those that are tested"
	@echo "make clean       remove the environment, the site and run outputs"

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	@touch $@

search: $(STAMP)
	$(BIN)/python -m eval.search

docs: $(STAMP)
	$(BIN)/python -m docs.site

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(STAMP)
	$(BIN)/mypy

# The type checker and the numbers have one core each.
test: lint
	$(MAKE) --jobs=2 types numeric
	$(PYTEST) -m "not lab and not long"

# Numbers are computed a second time as on a processor without AVX, on one thread: other processors round otherwise.
# Graphs are traced alike on all of them, a pretended GPU computes as the CPU does, and agents only combine these numbers.
numeric: $(STAMP)
	ATEN_CPU_CAPABILITY=default OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -m "not lab and not long and not slow" \
		-k "not compile and not export and not gradcheck and not cuda" $(NUMERIC)

# Some of these tests build the site.
lab: $(STAMP)
	$(PYTEST) -m "lab and not long"

test-all: lint types
	$(PYTEST) -m ""

test-quick: $(STAMP)
	$(PYTEST) -m "not slow and not long"

gpu: $(STAMP)
	$(BIN)/python -c "import sys, torch; sys.exit(None if torch.cuda.is_available() else 'no GPU that torch can use')"
	$(BIN)/python -m pytest -m "not long" -k "cuda or test_devices"
	$(BIN)/python -m benchmarks.gpu

# Of the processes that tests start, too.
coverage: $(STAMP)
	rm -rf build/coverage && mkdir -p build/coverage
	$(BIN)/python -m coverage run -m pytest -n 2 --dist loadfile --no-loadscope-reorder
	$(BIN)/python -m coverage combine --quiet
	$(BIN)/python -m coverage html --quiet
	$(BIN)/python -m coverage report

# Where graphs are traced, mutants cannot be switched. What has been run is kept in mutants/: call it again to go on.
mutation: $(STAMP)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[mutation]"
	TORCHDYNAMO_DISABLE=1 OMP_NUM_THREADS=1 $(BIN)/mutmut run
	$(BIN)/python -m benchmarks.mutation

constraints: $(STAMP)
	$(BIN)/python .ci/constraints.py

clean:
	rm -rf $(VENV) .cache build dist mutants runs
