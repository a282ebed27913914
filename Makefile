PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
GRADIO := build/gradio
# An environment is brought up to date with the builds of PyTorch that it was made with.
CPU_WHEELS ?= $(shell cat $(VENV)/cpu_wheels.txt 2>/dev/null)
# Of files that name all packages; bytecode is written when a module is first imported.
INSTALL := install --quiet --no-compile --no-deps --require-hashes --requirement
INSTALL_CPU = install --quiet --no-compile --no-deps \
	$(if $(findstring ://,$(CPU_WHEELS)),--index-url,--no-index --find-links) "$(CPU_WHEELS)" --requirement
LOCK := $(BIN)/uv pip compile --quiet --universal --python-version 3.11.5 --generate-hashes --no-annotate \
	--custom-compile-command "make constraints"
# The tests of a file stay together: what they share is made once.
PYTEST := $(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder

# Tests are rewritten and start many processes: bytecode that is kept halves the time to collect them.
unexport PYTHONDONTWRITEBYTECODE

NUMERIC := tests/belief tests/decision tests/observation tests/sensor \
	$(patsubst %,tests/head/test_%.py,belief modules) \
	$(patsubst %,tests/zoom/test_%.py,belief decision modules survey)

.DEFAULT_GOAL := help
.PHONY: help setup search test numeric library lab app test-all test-quick gpu coverage mutation docs lint types constraints clean

help:
	@echo "make setup       make the environment .venv; CPU_WHEELS=ADDRESS spares CUDA (docs/install.md)"
	@echo "make search      set up, search the embedded scenes, write tables and pictures"
	@echo "make test        set up, then lint, types and the tests of the library"
	@echo "make lab         the tests of studies, whole fits, benchmarks and the site"
	@echo "make app         the page on which to try an agent out, in Chromium"
	@echo "make test-quick  the tests that take no more than a second each"
	@echo "make test-all    all of these, with the tests that repeat others at length"
	@echo "make gpu         on a machine with a GPU: the tests that use one, and a page of benchmarks"
	@echo "make coverage    the tests, and which lines and branches they reach"
	@echo "make mutation    change the library's formulas one by one, and list the changes that no test notices (hours)"
	@echo "make docs        set up, then build the site in build/site"
	@echo "make constraints write the tested versions anew, after a change of the dependencies"
	@echo "make clean       remove the environment, the site and run outputs"

setup: $(STAMP)

# Three processes unpack the packages: torch, its libraries and all others are about equally large. PyTorch's builds for
# the CPU have other digests than those of constraints.txt, and need no CUDA. CPU may be in the environment for other ends.
$(STAMP): pyproject.toml constraints.txt
	$(if $(and $(findstring command line,$(origin CPU)),$(CPU)),$(if $(CPU_WHEELS),,$(error CPU: expected \
		CPU_WHEELS=ADDRESS too, the one after --index-url in the command for Linux, Pip and CPU on PyTorch's install page \
		(docs/install.md), or a folder of these wheels)))
	$(PYTHON) -m venv $(VENV)
	$(if $(CPU_WHEELS),echo "$(CPU_WHEELS)" >$(VENV)/cpu_wheels.txt)
	awk '/^[a-z]/ {part = /^(nvidia|cuda|triton)/ ? "cuda" : /^torch(vision)?=/ ? "torch" : "others"} \
		/^torch(vision)?=/ {print $$1 >("$(VENV)/cpu.txt")} \
		/^[a-z ]/ {print >("$(VENV)/" part ".txt")}' constraints.txt
	printf "$(VENV)/%s.txt\n" $(if $(CPU_WHEELS),others,cuda torch others) | \
		xargs -n 1 -P 3 $(BIN)/python -m pip $(INSTALL)
	$(if $(CPU_WHEELS),$(BIN)/python -m pip $(INSTALL_CPU) $(VENV)/cpu.txt)
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	$(BIN)/python -m compileall -q semfov  # as pip does with a wheel: the first picture does not wait for it
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

# Types and numbers are checked while the tests run: no core waits for another.
test: lint
	$(MAKE) --jobs=3 types numeric library

library: $(STAMP)
	$(PYTEST) -m "not lab and not long" $(addprefix --ignore=,$(NUMERIC))

# Numbers are computed as on a processor without AVX, on one thread, since other processors round otherwise. With AVX they
# are computed by all targets but this one, and by pytest alone.
numeric: $(STAMP)
	ATEN_CPU_CAPABILITY=default OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q -m "not lab and not long" $(NUMERIC)

# Some of these tests build the site.
lab: $(STAMP)
	$(PYTEST) -m "lab and not long"

# Gradio needs an older Pillow than the other tests, so it lies in an environment of its own, on top of theirs. Its own
# warnings are not errors.
app: $(GRADIO)/.installed
	$(GRADIO)/bin/python -m pytest -W default -k "telephone or http" tests/cli/test_app.py tests/cli/test_app_requests.py

$(GRADIO)/.installed: $(STAMP) .ci/app.txt
	$(BIN)/python -m venv $(GRADIO)
	$(BIN)/python -c "import sysconfig; print(sysconfig.get_path('purelib'))" \
		>"$$($(GRADIO)/bin/python -c "import sysconfig; print(sysconfig.get_path('purelib'))")/tests.pth"
	$(GRADIO)/bin/python -m pip $(INSTALL) .ci/app.txt
	@touch $@

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
	$(BIN)/python -m pip install --quiet --no-build-isolation --editable ".[mutation]"
	TORCHDYNAMO_DISABLE=1 OMP_NUM_THREADS=1 $(BIN)/mutmut run
	$(BIN)/python -m benchmarks.mutation

# For all platforms, with the digests of all files. Versions stay as they are, but for NEWEST=--upgrade.
constraints: $(STAMP)
	$(BIN)/python -m pip install --quiet uv
	$(LOCK) $(NEWEST) --extra dev pyproject.toml --output-file constraints.txt
	cp constraints.txt .ci/app.txt
	echo gradio | $(LOCK) - --output-file .ci/app.txt
	cp constraints.txt .ci/build.txt
	printf "build\nhatchling\n" | $(LOCK) - --output-file .ci/build.txt

clean:
	rm -rf $(VENV) .cache build dist mutants runs
