# Two commands: `make demo` and `make test`.  Both install what they need into .venv.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
OUT ?= out

.PHONY: demo test lint blind test-oldest clean

demo: $(VENV)/ready
	$(BIN)/fisheye-svp demo -o $(OUT)/demo

test: $(VENV)/ready lint
	$(BIN)/python -m pytest

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/mypy

# All blind tests of the diagnosis; takes long.
blind: $(VENV)/ready
	$(BIN)/python -m benchmark.blind --trials 200

# The oldest versions that are supported: those of Ubuntu 24.04 and OpenCV 4.6.
test-oldest:
	$(PYTHON) -m venv .venv-oldest
	.venv-oldest/bin/pip install --quiet -e '.[standalone,test]' -c test/oldest.txt
	.venv-oldest/bin/python -m pytest

$(VENV)/ready: setup.py
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet -e '.[standalone,test,lint]'
	touch $@

clean:
	rm -rf $(VENV) .venv-oldest $(OUT)
