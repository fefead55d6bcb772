# Each target does its own set-up: Python 3.11 and nothing else is needed.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
# one thread per BLAS call: the work is parallel in processes, and oversubscription costs a factor of ten
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1

.PHONY: run test test-all lint bench setup clean

run: setup
	$(BIN)/micron run

test: setup lint
	$(BIN)/pytest -n 2 -m "not slow and not realtime" -q
	$(BIN)/pytest -m "realtime and not slow" -q

test-all: test
	$(BIN)/pytest -m "slow" -q

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

bench: setup
	$(BIN)/python -m benchmarks

setup: $(VENV)/.ready

# the stamp is touched only when every step has worked, so that a half-made environment is made again
$(VENV)/.ready: pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed, this is " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
