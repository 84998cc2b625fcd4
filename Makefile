# `make demo` and `make test` need Python 3.11 or newer, make and a C compiler; everything else goes into .venv.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
BASE   := $(VENV)/.base
STAMP  := $(VENV)/.installed
BPY    := build/blender

# Containers often ask Python to keep no bytecode. Each of the many processes of the tests would compile all modules.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-all lint format docs benchmarks blender clean

# Without what only the tests need: that would be half of all that is installed.
demo: $(BASE)
	$(BIN)/cuspid run --tooth 46 --out demo

# Three workers for two cores: those that wait for processes and disks would leave a fifth of the time unused. One BLAS
# thread for each: more would only wait for one another.
test: $(STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 3 --dist loadfile -m "not documentation and not long"

# With the long closed loops, those of Blender and of a browser, all of the fuzzer's scenarios, and more examples of laws.
test-all: $(STAMP)
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 3 --dist loadfile -m "not documentation" --hypothesis-profile all

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# A warning, as of a link that leads nowhere, is an error, and so is a command on a page, or an example, that does not
# run, or a figure that is not that of the results.
docs: $(STAMP).docs
	$(BIN)/python benchmarks/quoted.py --check
	$(BIN)/sphinx-build --quiet --fail-on-warning --doctree-dir build/doctrees docs build/docs
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 -m documentation tests/whole/test_docs.py tests/whole/test_examples.py
	@echo "build/docs/index.html"

benchmarks: $(STAMP)
	$(BIN)/python benchmarks/run.py --out benchmarks/results

# For the renderer blender and its tests, where CUSPID_BLENDER_PYTHON is build/blender/bin/python.
blender: $(BPY)/.installed

$(BPY)/.installed: constraints-blender.txt
	python3.11 -m venv $(BPY)
	$(BPY)/bin/pip install --quiet --disable-pip-version-check --constraint constraints-blender.txt bpy
	$(BPY)/bin/python -c 'import bpy'
	touch $@

$(BASE): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "cuspid needs Python 3.11 or newer; name one with: make PYTHON=python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable .
	touch $(BASE)

$(STAMP): $(BASE) reproduction/pyproject.toml
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]' --editable reproduction
	touch $(STAMP)

$(STAMP).docs: $(STAMP)
	$(BIN)/pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) demo build docs/api docs/cli
