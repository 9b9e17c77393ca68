# make demo | make test | make lint | make docs | make package | make benchmark. Each installs its packages in .venv first. PYTHON=python3.12 selects
# another Python.
PYTHON ?= python3
VENV ?= .venv
# Tests to run, as for pytest's -m. TESTS= selects all tests.
TESTS ?= not slow
# Files and folders of the tests. Default: all.
PATHS ?=
# Module or folder of the package that `make mutants` changes.
MUTATE ?= dvrk_drake/systems/guard
BIN := $(VENV)/bin
# Without stored bytecode, each process compiles the package and the tests again: 12 s of CPU time per test worker.
export PYTHONDONTWRITEBYTECODE :=
# Files with network tests. Pytest would import all other files, too.
NETWORK_FILES = $(shell grep -rl --include='test_*.py' '^pytestmark.*mark\.network' tests | grep -v 'udp/')
AND_TESTS = $(if $(TESTS), and $(TESTS))

.PHONY: demo test test-all test-busy test-local test-network test-realtime mutants lint docs package test-package benchmark clean

demo: $(VENV)/.installed
	$(BIN)/dvrk-drake demo --folder demo_output --overwrite

# Tests of everything that a change can break. test-all adds tests that repeat others with another arm, draw or duration,
# and tests with a browser, long recordings or the dVRK console.
# Network tests that are not in real time mostly wait, so they run beside the others. Their output follows.
test: $(VENV)/.installed-test
	@set -e; output=$$(mktemp); $(MAKE) --no-print-directory test-network >$$output 2>&1 & network=$$!; \
	  trap "kill $$network 2>/dev/null || :; rm -f $$output" EXIT INT TERM; \
	  result=0; $(MAKE) --no-print-directory test-local || result=$$?; \
	  wait $$network || result=$$?; cat $$output; \
	  $(MAKE) --no-print-directory test-realtime || result=$$?; exit $$result

test-all:
	$(MAKE) test TESTS=

# Runs the tests while two busy processes run. No test may depend on the load of the computer.
test-busy:
	@set -e; busy() { while :; do :; done; }; \
	  busy & first=$$!; busy & trap "kill $$first $$! 2>/dev/null || :" EXIT INT TERM; $(MAKE) test

# The run ends when a worker dies. Tests are in the order of the files, so the workers rarely create a fixture twice.
test-local: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n 2 --dist worksteal --max-worker-restart 0 -m 'not network$(AND_TESTS)' $(PATHS)

test-network: $(VENV)/.installed-test
	$(BIN)/python -m pytest -m 'network and not realtime$(AND_TESTS)' $(or $(PATHS),$(NETWORK_FILES))

# One after the other, since each test runs several processes at 1 kHz and needs all cores.
test-realtime: $(VENV)/.installed-test
	$(BIN)/python -m pytest -m 'realtime$(AND_TESTS)' $(or $(PATHS),tests/udp)

# Mutation testing: lists changes of the code that no test detects. Not part of CI, since it takes many minutes.
mutants: $(VENV)/.installed-test
	nice -n 10 $(BIN)/python tools/mutants.py $(MUTATE)

lint: $(VENV)/.installed-lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The documentation site, in docs/_build/html. The tutorials are executed; unchanged ones are taken from a cache. The
# build needs no network.
docs: $(VENV)/.installed-docs
	$(BIN)/sphinx-build -W --keep-going -q -d docs/_build/doctrees docs docs/_build/html
	@! grep -rlE '<(script|link|img)[^>]+="https?://' docs/_build/html --include='*.html' || \
	  { echo "These pages load files from the network."; exit 1; }
	@echo "wrote docs/_build/html/index.html"

# Wheel and source distribution, in dist.
package: $(VENV)/.installed-package
	rm -rf dist
	$(BIN)/python -m build --outdir dist >/dev/null

# Installs the wheel into an empty environment, then the source distribution instead, and runs commands with each.
test-package: package
	$(BIN)/python tools/test_package.py dist

benchmark: $(VENV)/.installed-benchmark
	$(BIN)/python benchmarks/gravity_regressor.py
	$(BIN)/python benchmarks/dynamic_regressor.py
	$(BIN)/python benchmarks/control_step.py
	$(BIN)/python benchmarks/first_tick.py
	$(BIN)/python benchmarks/psm_simulation.py

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "Python 3.11 or newer is required. Select one, e.g.: make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(VENV)/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

# Each extra has its own stamp file, so that the demo does not install the linters.
$(VENV)/.installed-%: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$*]'
	touch $@

# numba does not notice changes of compiled functions in other files than that of the caller.
clean:
	rm -rf $(VENV) demo_output docs/_build docs/generated dist
	find dvrk_drake -name '*.nb[ci]' -delete
