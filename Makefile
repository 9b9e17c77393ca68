# make demo | make test | make lint | make benchmark: each sets itself up in .venv first. PYTHON=python3.12 picks another.
PYTHON ?= python3
VENV ?= .venv
# Which tests test-fast runs, as pytest's -m; TESTS= runs all of them, as CI does.
TESTS ?= not slow
# Files and folders whose tests test-fast runs; default: all.
PATHS ?=
# CI leaves out the PSM's collection, which is the MTM's again with another arm.
RECORDINGS ?= tests/udp/test_record_udp.py tests/udp/test_collect_udp.py tests/udp/test_collect_psm_udp.py
# What `make mutants` changes: a module or a folder of the package.
MUTATE ?= dvrk_drake/systems/guard
BIN := $(VENV)/bin

.PHONY: demo test test-busy test-fast test-udp test-recordings mutants lint benchmark clean

demo: $(VENV)/.installed
	$(BIN)/dvrk-drake demo --folder demo_output --overwrite

test: test-fast test-udp

# No test may depend on what else the computer does: the same beside two processes that never wait.
test-busy:
	@set -e; busy() { while :; do :; done; }; \
	  busy & first=$$!; busy & trap "kill $$first $$! 2>/dev/null || :" EXIT INT TERM; $(MAKE) test

test-fast: $(VENV)/.installed-test
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --ignore-glob='*_udp.py' -m '$(TESTS)' $(PATHS)

# One after the other: each runs several processes at 1 kHz, and wants the cores for itself.
test-udp: $(VENV)/.installed-test
	$(BIN)/python -m pytest tests/udp/test_lcm_udp.py

# Recordings over UDP, and collections of both arms from the first pose to the release: minutes.
test-recordings: $(VENV)/.installed-test
	$(BIN)/python -m pytest $(RECORDINGS)

# Mutation testing: which changes of the code no test detects. Not part of CI, since it takes many minutes.
mutants: $(VENV)/.installed-test
	nice -n 10 $(BIN)/python tools/mutants.py $(MUTATE)

lint: $(VENV)/.installed-lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

benchmark: $(VENV)/.installed-benchmark
	$(BIN)/python benchmarks/gravity_regressor.py
	$(BIN)/python benchmarks/dynamic_regressor.py
	$(BIN)/python benchmarks/control_step.py
	$(BIN)/python benchmarks/psm_simulation.py

$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "needs Python 3.11 or newer; name one: make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: $(VENV)/bin/python pyproject.toml constraints.txt
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $@

# Each extra has a stamp of its own, so that a user of the demo need not wait for the linters.
$(VENV)/.installed-%: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$*]'
	touch $@

clean:
	rm -rf $(VENV) demo_output
