# Two commands: `make demo` and `make test`. Each sets up .venv by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin

.PHONY: demo test modes fuzz coverage check chaos mcap bench bench-recorder scale clean

demo: $(VENV)/ready  ## run the image processing system on a real photograph
	$(BIN)/python -m examples.image_system

test: $(VENV)/ready  ## run every test on an embedded real server
	$(BIN)/python -m pytest -q

modes: $(VENV)/ready  ## tests once in Python's development mode, and once without assert statements
	$(BIN)/python -X dev -m pytest -q tests/test_store.py tests/test_subscribe.py tests/test_connection.py tests/test_facade_store.py
	$(BIN)/python -O -m pytest -q -W "ignore:assertions not in test modules" \
		tests/test_bad_input.py tests/test_store.py tests/test_pure.py tests/test_regressions.py

fuzz: $(VENV)/ready  ## random bytes against everything that decodes, for a minute each
	$(BIN)/python -m tests.fuzz

coverage: $(VENV)/ready  ## branches that the tests take, without those that run in other processes
	$(BIN)/python -m coverage run --branch --source=reem,reem_async -m pytest -q
	$(BIN)/python -m coverage report --skip-covered --sort=cover | tail -60

check: $(VENV)/ready  ## format, lint and type checks
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

$(VENV)/ready: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@

chaos: $(VENV)/ready  ## the reliability scoreboard, under 20 minutes; CHAOS="--rows 1,9 --seed 7"
	$(BIN)/python -m tests.chaos $(CHAOS)

mcap: $(VENV)/ready  ## recordings, read by the TypeScript implementation of MCAP that Foxglove uses; needs npm
	npm install --silent --no-fund --no-audit --no-package-lock --prefix tests/mcapcheck
	$(BIN)/python -m tests.mcapcheck

bench: .venv-bench/ready  ## every benchmark, under ten minutes; BENCH=--quick for about one
	.venv-bench/bin/python -m benchmarks $(BENCH)

bench-recorder: .venv-bench/ready  ## what a recorder costs the writers beside it, 14 to 40 minutes
	.venv-bench/bin/python -m benchmarks.recorder

scale: .venv-bench/ready  ## cost per operation, and docs/scale.md from it, under four minutes; SCALE=--quick
	.venv-bench/bin/python -m benchmarks.scale $(SCALE)

.venv-bench/ready: pyproject.toml
	$(PYTHON) -m venv .venv-bench
	.venv-bench/bin/python -m pip install --quiet --disable-pip-version-check -e '.[bench]'
	touch $@

clean:  ## remove the virtual environment and caches
	rm -rf $(VENV) .venv-bench .mypy_cache .pytest_cache .ruff_cache .hypothesis
