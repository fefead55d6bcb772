# Each target does its own set-up: Python 3.11 and nothing else is needed.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
# one thread per BLAS call: the work is parallel in processes, and oversubscription costs a factor of ten
export OMP_NUM_THREADS = 1
export OPENBLAS_NUM_THREADS = 1
# compiled modules are kept: without them every process of the tests compiles its imports anew
unexport PYTHONDONTWRITEBYTECODE
# versions and hashes of everything, of what builds the package as well
INSTALL = VIRTUAL_ENV=$(VENV) $(BIN)/uv pip install --quiet -c constraints.txt -b constraints.txt

.PHONY: run test unit realtime speed test-all lint audit fuzz bench docs pictures wheel coverage mutation quality constraints setup clean

run: setup
	$(BIN)/micron run

test: lint unit realtime

unit: setup
	$(BIN)/pytest -n 2 -m "not slow and not realtime" -q

realtime: setup
	$(BIN)/pytest -m "realtime and not slow" -q

# of the unit tests the one that a tracer would slow down
speed: setup
	$(BIN)/pytest -q tests/perf

test-all: test
	$(BIN)/pytest -m "slow" -q

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright
	$(BIN)/lint-imports

# of everything that is installed and of all extras: fails on a known vulnerability that has a repair; says so and goes on
# where the database cannot be reached
audit: setup
	$(BIN)/python -m tools.research.supply.audit

# pins and hashes of the project and all extras again; make constraints UPGRADE="numpy uv" takes newer ones of these
UPGRADE ?=
LOCK = $(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header --no-annotate \
  $(addprefix --upgrade-package ,$(UPGRADE))
constraints: setup
	grep '^#' constraints.txt > constraints.new && grep '^#' uv-pin.txt > uv-pin.new
	cp constraints.txt constraints.out && cp uv-pin.txt uv-pin.out
	printf 'hatchling\neditables\n' | $(LOCK) pyproject.toml - --all-extras -o constraints.out
	echo uv | $(LOCK) - -o uv-pin.out
	cat constraints.out >> constraints.new && mv constraints.new constraints.txt && rm constraints.out
	cat uv-pin.out >> uv-pin.new && mv uv-pin.new uv-pin.txt && rm uv-pin.out

# coverage guided, 60 s per parser, one parser per core: make fuzz SECONDS=600 TARGET=own_recording
SECONDS ?= 60
SEED    ?= 0
TARGET  ?= all
fuzz: setup
	$(INSTALL) -e '.[fuzz]'
	$(BIN)/python -m tests.fuzz.run $(TARGET) --seconds $(SECONDS) --seed $(SEED)

# installs the peers that it compares with; make bench ONLY="step world" for some of it, ROUNDS=5 for medians of five
ROUNDS  ?= 1
bench: setup
	$(INSTALL) -e '.[bench]'
	$(BIN)/python -m benchmarks $(ONLY) --rounds $(ROUNDS)

# the site in out/site; strict: a broken link or an undocumented name in the reference fails
docs: setup
	$(INSTALL) -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

# the pictures of the documents, of a running page; needs Chromium
pictures: setup
	$(BIN)/python -m tools.research.pictures docs/pictures

# the built package in an empty environment, away from the sources
wheel: setup
	rm -rf out/wheel
	$(BIN)/uv build --quiet -b constraints.txt --wheel --out-dir out/wheel
	$(BIN)/uv venv --quiet --python $(BIN)/python out/wheel/venv
	VIRTUAL_ENV=out/wheel/venv $(BIN)/uv pip install --quiet -c constraints.txt -b constraints.txt out/wheel/*.whl
	$(BIN)/python -m zipfile -l out/wheel/*.whl > out/wheel/files.txt
	for file in hal/py.typed drivers/dbc/micron.dbc benches/calibration/piezo.toml tools/bench/static/index.html; do \
	  grep -q "^$$file " out/wheel/files.txt || { echo "the wheel lacks $$file"; exit 1; }; done
	! grep "^tools/research/" out/wheel/files.txt
	cd out/wheel && PYTHONPATH= venv/bin/micron --version && PYTHONPATH= venv/bin/micron run --virtual --seconds 2

# coverage by branch of every room, CORES folders of tests at a time: a run that was stopped goes on where it was, and begins
# anew once a source has changed. A test that fails ends it after the other folders, and the next run measures its
# folder again; a test has 20 minutes under the tracer. Kernels are left out (a tracer cannot see compiled code; their pure-Python twins are
# tested), and so is what runs in processes of its own. Of the slow tests only the sample SLOW runs: the examples of every
# command's help, which reach the commands, and diagnoses of whole recordings, which reach the mismatch engine
CORES ?= 2
SLOW = tests/unit/cli/test_worked_examples.py tests/unit/mismatch_engine
FOLDERS = $(filter-out tests/perf tests/examples/%,$(patsubst %/,%,$(sort $(dir $(wildcard tests/*/test_*.py tests/*/*/test_*.py)))))
MEASURED = $(FOLDERS:%=out/coverage/%.data) $(SLOW:%=out/coverage/slow/%.data)
SOURCES = $(shell git ls-files '*.py')
out/coverage/slow/%.data: MARK = slow
out/coverage/%.data: MARK = not slow and not realtime
define measure
mkdir -p $(@D) && rm -f $@.part
COVERAGE_FILE=$@.part $(BIN)/pytest -q -m "$(MARK)" $* -o timeout=1200 --cov --cov-report= --cov-fail-under=0 || \
  [ $$? -eq 5 ]
if [ -e $@.part ]; then mv $@.part $@; else touch $@; fi
endef
# two rules: one rule of two patterns would take the slow tests of a folder for done with its others
out/coverage/slow/%.data: $(SOURCES)
	$(measure)
out/coverage/%.data: $(SOURCES)
	$(measure)
coverage: setup quality
	$(MAKE) -k -j $(CORES) $(MEASURED)
	$(BIN)/coverage combine -q --keep --data-file=out/coverage/all $$(find out/coverage -name '*.data' -size +0)
	for room in hal:90 drivers:90 firmware_py:90 sim_devices:85 tools:85; do \
	  $(BIN)/coverage report --data-file=out/coverage/all --include="$${room%:*}/*" --fail-under=$${room#*:} \
	    --skip-covered --sort=cover || exit 1; done

# does a test fail when a line is changed? minutes to an hour; make mutation ONLY="safety can" for some of it
mutation: setup quality
	$(BIN)/python -m tests.mutation.run $(ONLY)

quality: setup
	$(INSTALL) -e '.[quality]'

setup: $(VENV)/.ready

# the stamp is touched only when every step has worked, so that a half-made environment is made again
$(VENV)/.ready: pyproject.toml constraints.txt uv-pin.txt
	$(PYTHON) -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed, this is " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r uv-pin.txt
	$(INSTALL) -e '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache build dist
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
