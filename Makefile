# Two commands: `make demo` and `make test`.  Both install what they need into .venv.
# The first Python that there are wheels of ROS 2 for; any other with `make PYTHON=...`.
ifndef PYTHON
PYTHON := $(firstword $(foreach python,python3 python3.14 python3.13 python3.12 python3.11,\
	$(shell $(python) -c 'import sys; (3, 11) <= sys.version_info < (3, 15) and print("$(python)")' 2>&-)) python3)
endif
# ROS 2 out of pip, but not beside one that is sourced. One of an activated environment does not
# count: $(VENV) does not see it.
COMMA := ,
ROS := $(if $(shell $(PYTHON) -c 'import sys, rclpy.node; \
	rclpy.__file__.startswith(sys.prefix) or print("sourced")' 2>&-),,$(COMMA)ros)
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= out
# One more than there are cores: tests of nodes wait for messages most of the time.
WORKERS ?= $(shell expr $$(env -u OMP_NUM_THREADS nproc) + 1)
# Further arguments of pytest, for example PYTEST='-k lens'.
PYTEST ?=
# Rooms whose tests start no process, nor diagnose whole sets.
QUICK := $(patsubst %,test/%,optics scene mixed_model effects io simulate solve rectify detect study reporting library) \
	$(patsubst %,test/test_%.py,documents pose)
# Kept, whatever the environment says: tests start hundreds of processes.
export PYTHONDONTWRITEBYTECODE :=
# setuptools has a long notice for every editable installation.
QUIETLY := PYTHONWARNINGS='ignore:Editable installation'
# By a path, which type checkers and editors follow, as they do no import hook.
EDITABLE := --config-settings editable_mode=compat -e

.PHONY: demo check test test-all tests coverage lint paper docs study hardening peers bench test-oldest clean

demo: $(VENV)/ready
	$(BIN)/fisheye-svp demo -o $(OUT)/demo

# One thread each for NumPy, since the tests are spread over all cores.
check tests coverage test-oldest: export OMP_NUM_THREADS := 1
# The linters run beside the first tests.
test: $(VENV)/ready
	$(MAKE) --no-print-directory -j2 lint tests

# Also what test/long_tests.txt names: before a release.
test-all: $(VENV)/ready
	$(MAKE) --no-print-directory -j2 lint tests MARKED=

MARKED ?= -m 'not long'
tests: $(VENV)/ready
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup $(MARKED) $(PYTEST)

# For every save: lint, and the tests that take under two minutes on two cores.
check: $(VENV)/ready lint
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup -m 'not slow' $(QUICK) $(PYTEST)

# All tests, and which lines of the package they run.
coverage: $(VENV)/ready
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup --cov=fisheye_svp_ros \
		--cov-report=term:skip-covered $(PYTEST)

lint: $(VENV)/ready
	$(BIN)/ruff format --check --quiet .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

# The paper's tables and figures beside ours.
paper: $(VENV)/ready
	$(BIN)/fisheye-svp paper -o $(OUT)/paper

# The site, with the Python API and a search, into out/site; needs no network.
docs: $(VENV)/ready
	$(BIN)/sphinx-build -W --keep-going -q docs $(OUT)/site

# A study of simulated sets, into docs/results/: make study NAME=decisions [ARGS='--trials 20'].
# Names are the modules of benchmark/studies/; minutes to hours.
study: $(VENV)/ready
	$(BIN)/python -m benchmark.studies.$(NAME) $(ARGS)

# Hostile input, killed commands, small faults in the code, statistical rules taken out, frozen
# answers: make hardening NAME=fuzz, soak, kills (as root), mutation, rules or frozen.
hardening: $(VENV)/ready
	$(if $(filter mutation,$(NAME)),$(BIN)/pip install --quiet 'cosmic-ray>=8.3' 'pytest-cov>=7')
	$(BIN)/python -m benchmark.hardening.$(NAME) $(ARGS)

# The same corners through other tools, into docs/results/: make peers NAME=compare ARGS=DATA,
# travel, rectification, rigs or hand_eye; a minute to half an hour.
PEERS_compare := .venv-compare
PEERS_travel := $(VENV)
PEERS_rectification := .venv-compare
PEERS_rigs := $(VENV)
PEERS_hand_eye := .venv-hand-eye
peers: $(PEERS_$(NAME))/ready $(if $(filter rigs,$(NAME)),.venv-rigs/ready)
	$(PEERS_$(NAME))/bin/python -m benchmark.peers.$(NAME) $(ARGS)

# Speed beside what a user would pick instead, into docs/results/benchmarks.md; leave the machine alone.
bench: .venv-bench/ready
	.venv-bench/bin/python -m benchmark.speed

.venv-bench/ready: setup.py benchmark/requirements.txt
	@echo "Installing what is compared into .venv-bench: some minutes, this once"
	$(PYTHON) -m venv .venv-bench
	.venv-bench/bin/pip install --quiet --upgrade pip
	$(QUIETLY) .venv-bench/bin/pip install --quiet $(EDITABLE) '.[fast,parquet$(ROS)]' -r benchmark/requirements.txt
	.venv-bench/bin/pip install --quiet --no-deps mrcal || echo 'mrcal: not to be had here'
	test -d .venv-bench/mrcal || git clone --quiet --depth 1 https://github.com/dkogan/mrcal \
		.venv-bench/mrcal || echo 'mrcal: no sources to be had; its rows are left out'
	touch $@

# mrcal without what only its windows need, which wants to be compiled; the others without the
# OpenCV that they ask for, which would overwrite the one that is here.
COMPARE_PYTHON ?= python3.12
.venv-compare/ready: setup.py
	@echo "Installing what is compared into .venv-compare: some minutes, this once"
	$(COMPARE_PYTHON) -m venv .venv-compare
	$(QUIETLY) .venv-compare/bin/pip install --quiet $(EDITABLE) '.[fast]' numpysane gnuplotlib packaging pyyaml
	for peer in mrcal lensboy calibsense ds-msp; do .venv-compare/bin/pip install --quiet \
		--no-deps $$peer || echo "$$peer: not to be had here"; done
	touch $@

.venv-rigs/ready:
	$(PYTHON) -m venv .venv-rigs
	.venv-rigs/bin/pip install --quiet multical==0.4.0 pycolmap 'numpy<2'
	touch $@

# OpenCV 5 has no hand-eye calibration any more.
.venv-hand-eye/ready: setup.py
	$(PYTHON) -m venv .venv-hand-eye
	$(QUIETLY) .venv-hand-eye/bin/pip install --quiet $(EDITABLE) '.[fast]' 'opencv-python-headless<5'
	touch $@

# The oldest versions that are supported: those of Ubuntu 24.04 and OpenCV 4.6.
test-oldest:
	@echo "Installing the oldest versions into .venv-oldest: about a minute"
	$(PYTHON) -m venv .venv-oldest
	$(QUIETLY) .venv-oldest/bin/pip install --quiet $(EDITABLE) '.[fast,parquet,test$(ROS)]' -c test/oldest.txt
	.venv-oldest/bin/python -m pytest -n $(WORKERS) --dist loadgroup

# Modules are compiled when they are first imported: most never are.
$(VENV)/ready: setup.py
	@echo "Installing the package and its tools into $(VENV): about a minute, this once"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(QUIETLY) $(BIN)/pip install --quiet --no-compile $(EDITABLE) '.[fast,parquet,dask,test,lint,docs$(ROS)]'
	touch $@

clean:
	rm -rf $(VENV) .venv-oldest .venv-bench .venv-compare .venv-rigs .venv-hand-eye $(OUT)
