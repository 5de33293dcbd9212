# Two commands do everything: `make demo` and `make test`. Each sets up what it needs and can be run again.

PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# The CPU build of torch; without this index pip takes several gigabytes of CUDA along.
TORCH_INDEX ?= https://download.pytorch.org/whl/cpu
PIP := $(BIN)/python -m pip --disable-pip-version-check
# Results depend on some dependencies' versions; a robot's install need not hold them.
INSTALL := $(PIP) install --quiet --constraint constraints.txt
NUMERIC_TESTS := $(addprefix test/,aerial_map clouds datasets encoder evaluation localization simulation training)

.PHONY: help setup demo test test-all test-portable lint docs docs-serve bench colcon clean

help:
	@echo "make demo      build the Amsterdam map, drive a simulated robot through it, localize it, write out/demo/index.html"
	@echo "make test      lint, types, import contracts and the quick tests"
	@echo "make test-all  the slow tests too"
	@echo "make test-portable  the numeric tests as on a processor without AVX-512"
	@echo "make docs      write the generated references and build the site into out/docs"
	@echo "make bench     latencies and rates beside this machine's matrix-multiply peak, to out/bench/"
	@echo "make colcon    build with colcon into install/, to check the ament packaging"

setup: $(VENV)/.ready

$(VENV)/.ready: setup.py constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Python 3.11 or newer is needed, $(PYTHON) is older; try: make PYTHON=python3.12"; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' || { echo "Python's venv is missing; try: sudo apt-get install python3-venv"; exit 1; }
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(INSTALL) --retries 1 --timeout 15 --extra-index-url $(TORCH_INDEX) torch
	$(INSTALL) --editable '.[ros,odometry,cluster,test]'
	touch $@

demo: setup
	$(BIN)/python -m crossloc3d_ros.cli.demo --output out/demo

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: lint
	$(BIN)/python -m pytest

test-all: lint
	$(BIN)/python -m pytest -m 'slow or not slow'

# What a test states must hold whatever the instruction set: NumPy's, Numba's and torch's sums round differently on each.
# A test that fails in only one of `test` and `test-portable` needs a margin, not another seed.
test-portable: export NPY_DISABLE_CPU_FEATURES = X86_V4 AVX512_ICL AVX512_SPR
test-portable: export NUMBA_CPU_NAME = generic
test-portable: export NUMBA_CACHE_DIR = $(abspath $(VENV))/numba-generic
test-portable: export ATEN_CPU_CAPABILITY = default
test-portable: setup
	$(BIN)/python -m pytest $(NUMERIC_TESTS)

docs: export NO_MKDOCS_2_WARNING = 1
docs: setup
	$(BIN)/python docs/generate.py
	$(BIN)/python -m mkdocs build --quiet --strict
	@echo "out/docs/index.html"

docs-serve: setup
	$(BIN)/python -m mkdocs serve

bench: setup
	$(BIN)/python -m bench --output out/bench

colcon: setup
	$(PIP) install --quiet colcon-common-extensions
	$(BIN)/colcon build --packages-select crossloc3d_ros --base-paths . --cmake-args

clean:
	rm -rf build install log out *.egg-info
