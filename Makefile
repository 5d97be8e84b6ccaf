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
QUICK := $(patsubst %,test/%,optics scene mixed_model effects io simulate solve rectify detect study reporting) \
	$(patsubst %,test/test_%.py,documents library pose)
# Kept, whatever the environment says: tests start hundreds of processes.
export PYTHONDONTWRITEBYTECODE :=
# setuptools has a long notice for every editable installation.
QUIETLY := PYTHONWARNINGS='ignore:Editable installation'

.PHONY: demo check test tests coverage lint paper paper-search blind blind-independent blind-images averaging image-field ray-coverage guided detectors docs bench compare decisions rectification hand-eye rigs kills mutation poses fuzz soak test-oldest clean

demo: $(VENV)/ready
	$(BIN)/fisheye-svp demo -o $(OUT)/demo

# One thread each for NumPy, since the tests are spread over all cores.
check tests coverage test-oldest: export OMP_NUM_THREADS := 1
# The linters run beside the first tests.
test: $(VENV)/ready
	$(MAKE) --no-print-directory -j2 lint tests

tests: $(VENV)/ready
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadgroup $(PYTEST)

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

# The paper's tables and figures beside ours; then the search for what the paper does not print
# (some minutes), which overwrites what it found before in config/.
paper: $(VENV)/ready
	$(BIN)/fisheye-svp paper -o $(OUT)/paper

paper-search: $(VENV)/ready
	$(BIN)/python -m benchmark.paper search
	$(BIN)/python -m benchmark.paper stopping

# The site, with the Python API and a search, into out/site; needs no network.
docs: $(VENV)/ready
	$(BIN)/sphinx-build -W --keep-going -q docs $(OUT)/site

# All blind tests of the diagnosis; takes long.
blind: $(VENV)/ready
	$(BIN)/python -m benchmark.blind --trials 200
	$(BIN)/python -m benchmark.local_errors --trials 200

# The same through rendered photographs: only the pictures are handed over; takes long, too.
blind-images: $(VENV)/ready
	$(BIN)/python -m benchmark.blind_images --trials 100

# What is decided about lenses whose truth is known, into docs/results/decisions.md.
decisions: $(VENV)/ready
	$(BIN)/python -m benchmark.decisions --trials 60

# How accurate detected corners are, into docs/results/detectors.md.
detectors: $(VENV)/ready
	$(BIN)/python -m benchmark.detectors --count 60

# The same with data of a generator that shares no code with the package; takes long, too, and
# goes on where it was interrupted.
blind-independent: $(VENV)/ready
	$(BIN)/python -m benchmark.independent --trials 69 -o $(OUT)/blind_independent

# What averaging over a viewpoint shift is worth, into docs/results/averaging.md and a picture.
averaging: $(VENV)/ready
	$(BIN)/python -m benchmark.averaging --sets 120

# What the image field in a lens file is worth, into docs/results/image_field.md.
image-field: $(VENV)/ready
	$(BIN)/python -m benchmark.image_field --sets 30

# Whether stated ray errors contain the true ones, into docs/results/ray_coverage.md.
ray-coverage: $(VENV)/ready
	$(BIN)/python -m benchmark.ray_coverage --sets 50

# The live guide tried on rendered images by somebody who holds the board, into docs/results/next/.
guided: $(VENV)/ready
	$(BIN)/python -m benchmark.guided

# Speed beside what a user would pick instead, into docs/results/benchmarks.md; leave the machine alone.
bench: .venv-bench/ready
	.venv-bench/bin/python -m benchmark.speed

.venv-bench/ready: setup.py benchmark/requirements.txt
	@echo "Installing what is compared into .venv-bench: some minutes, this once"
	$(PYTHON) -m venv .venv-bench
	.venv-bench/bin/pip install --quiet --upgrade pip
	$(QUIETLY) .venv-bench/bin/pip install --quiet -e '.[fast,parquet$(ROS)]' -r benchmark/requirements.txt
	.venv-bench/bin/pip install --quiet --no-deps mrcal || echo 'mrcal: not to be had here'
	test -d .venv-bench/mrcal || git clone --quiet --depth 1 https://github.com/dkogan/mrcal \
		.venv-bench/mrcal || echo 'mrcal: no sources to be had; its rows are left out'
	touch $@

# Held-out corners of real cameras through other calibrations, and halves of their frames, into
# docs/results/compare.md; half an hour.
COMPARE_PYTHON ?= python3.12
COMPARE_DATA ?= data
compare: .venv-compare/ready
	.venv-compare/bin/python -m benchmark.compare $(COMPARE_DATA)

# Rectified pairs of a lens whose viewpoint moves beside mrcal's and OpenCV's, into
# docs/results/rectification.md; a minute.
rectification: .venv-compare/ready
	.venv-compare/bin/python -m benchmark.rectification

# Rigs of four cameras beside OpenCV's multiview calibration, multical and pycolmap, into
# docs/results/rigs.md; ten minutes.
rigs: $(VENV)/ready .venv-rigs/ready
	$(BIN)/python -m benchmark.rigs

.venv-rigs/ready:
	$(PYTHON) -m venv .venv-rigs
	.venv-rigs/bin/pip install --quiet multical==0.4.0 pycolmap 'numpy<2'
	touch $@

# Cameras on robots beside OpenCV's hand-eye calibration, which OpenCV 5 has no more, into
# docs/results/hand_eye.md; five minutes.
hand-eye: .venv-hand-eye/ready
	.venv-hand-eye/bin/python -m benchmark.hand_eye

.venv-hand-eye/ready: setup.py
	$(PYTHON) -m venv .venv-hand-eye
	$(QUIETLY) .venv-hand-eye/bin/pip install --quiet -e '.[fast]' 'opencv-python-headless<5'
	touch $@

# mrcal without what only its windows need, which wants to be compiled; the others without the
# OpenCV that they ask for, which would overwrite the one that is here.
.venv-compare/ready: setup.py
	@echo "Installing what is compared into .venv-compare: some minutes, this once"
	$(COMPARE_PYTHON) -m venv .venv-compare
	$(QUIETLY) .venv-compare/bin/pip install --quiet -e '.[fast]' numpysane gnuplotlib packaging pyyaml
	for peer in mrcal lensboy calibsense ds-msp; do .venv-compare/bin/pip install --quiet \
		--no-deps $$peer || echo "$$peer: not to be had here"; done
	touch $@

# What spoilt views do to poses, into docs/results/reliability.md; ten minutes.
poses: $(VENV)/ready
	$(BIN)/python -m benchmark.poses

# Hostile input by the million for every reader, table and callback, into docs/results/reliability.md;
# half an hour.
fuzz: $(VENV)/ready
	$(BIN)/python -m benchmark.fuzz

# A million hostile messages over DDS against running nodes, into docs/results/reliability.md; half an hour.
soak: $(VENV)/ready
	$(BIN)/python -m benchmark.soak

# What is left of a command that is killed, or may not write, into docs/results/reliability.md; needs root
# for its small disks; an hour.
kills: $(VENV)/ready
	$(BIN)/python -m benchmark.kills

# How many of 300 small faults the tests find, into docs/results/mutation.md; goes on where it was
# interrupted; one and a half hours.
mutation: $(VENV)/ready
	$(BIN)/pip install --quiet 'cosmic-ray>=8.3' 'pytest-cov>=7'
	$(BIN)/python -m benchmark.mutation --sample 300

# The oldest versions that are supported: those of Ubuntu 24.04 and OpenCV 4.6.
test-oldest:
	@echo "Installing the oldest versions into .venv-oldest: about a minute"
	$(PYTHON) -m venv .venv-oldest
	$(QUIETLY) .venv-oldest/bin/pip install --quiet -e '.[fast,parquet,test$(ROS)]' -c test/oldest.txt
	.venv-oldest/bin/python -m pytest -n $(WORKERS) --dist loadgroup

# Modules are compiled when they are first imported: most never are.
$(VENV)/ready: setup.py
	@echo "Installing the package and its tools into $(VENV): about a minute, this once"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(QUIETLY) $(BIN)/pip install --quiet --no-compile -e '.[fast,parquet,dask,test,lint,docs$(ROS)]'
	touch $@

clean:
	rm -rf $(VENV) .venv-oldest .venv-bench .venv-compare $(OUT)
