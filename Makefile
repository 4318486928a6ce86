# Two commands: `make demo` and `make test`. Each sets up .venv by itself.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Four processes, each with a server of its own, take the test files in turns: tests also wait. The order is that of conftest.py.
TOGETHER := -n 4 --dist loadfile --no-loadscope-reorder
# The long run has more that needs the processor in time.
LONG := -n 2 --dist loadfile
# A cluster has three servers for each process, so one process fewer.
VARIANT := -n 3 --dist loadfile
# Programs are started by the hundred, and keep their bytecode: else each would compile all of REEM anew.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test test-all test-plain test-cluster modes coverage check chaos hunt watching slots week mcap recording bench bench-recorder scale clean docs dist floors

demo: $(VENV)/ready  ## run the image processing system on a real photograph
	$(BIN)/python -m examples.image_system

test: $(VENV)/ready  ## the fast run, about five minutes: every promise, on an embedded real server
	$(BIN)/python -m pytest -q $(TOGETHER)

test-all: $(VENV)/ready  ## the long run: every test at full size, then those that measure time, alone, and all variants
	$(BIN)/python -m pytest -q --long $(LONG) -m "not alone"
	$(BIN)/python -m pytest -q --long -m alone
	$(MAKE) test-plain test-cluster modes

test-plain: $(VENV)/ready  ## the fast run on servers without the JSON module
	REEM_TEST_SERVER=plain $(BIN)/python -m pytest -q $(VARIANT)

test-cluster: $(VENV)/ready  ## what the fast run does on its shared server, on a cluster of three
	REEM_TEST_SERVER=cluster $(BIN)/python -m pytest -q $(VARIANT)

modes: $(VENV)/ready  ## tests once in Python's development mode and once without assert statements
	$(BIN)/python -X dev -m pytest -q tests/test_store.py tests/test_subscribe.py tests/test_following.py tests/test_connection.py tests/test_facade_store.py
	$(BIN)/python -O -m pytest -q -W "ignore:assertions not in test modules" \
		tests/test_bad_input.py tests/test_store.py tests/test_pure.py tests/test_regressions.py

floors: .venv-floors/ready  ## the fast run's core on the lowest versions of dependencies that pyproject.toml allows
	.venv-floors/bin/python -m pytest -q $(TOGETHER) tests/test_package.py tests/test_store.py tests/test_subscribe.py \
		tests/test_cli.py tests/test_pytest_plugin.py tests/test_recording*.py tests/test_browser*.py

.venv-floors/ready: pyproject.toml $(VENV)/ready
	$(BIN)/uv venv -q --clear --python $(BIN)/python .venv-floors
	$(BIN)/uv pip install -q --python .venv-floors --resolution lowest-direct -e '.[server,tools,parquet,fast]'
	$(BIN)/uv pip install -q --python .venv-floors pytest pytest-asyncio pytest-xdist hypothesis httpx playwright trustme \
		mcap-protobuf-support mcap-ros2-support
	touch $@

dist: $(VENV)/ready  ## sdist and wheel in dist/, checked; then the README, followed with nothing but the wheel installed
	rm -rf dist out/wheel
	$(BIN)/uv build -q
	$(BIN)/uvx -q twine check --strict dist/*.whl dist/*.tar.gz
	$(BIN)/uv venv -q --python $(BIN)/python out/wheel
	$(BIN)/uv pip install -q --python out/wheel "$$(ls dist/*.whl)[server,tools]"
	REEM_TEST_PYTHON=$(CURDIR)/out/wheel/bin/python $(BIN)/python -m pytest -q tests/test_docs.py -k "followed and README"

coverage: $(VENV)/ready  ## branches that the tests take, without those that run in other processes
	$(BIN)/python -m coverage run --branch --source=reem,reem_async -m pytest -q
	$(BIN)/python -m coverage report --skip-covered --sort=cover | tail -60

check: $(VENV)/ready  ## format, lint and type checks
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python tests/words.py

docs: $(VENV)/ready  ## the documentation site, into out/docs; warnings are errors
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs out/docs

$(VENV)/ready: pyproject.toml
	@echo "Setting up $(VENV), about a minute, this once:"
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --progress-bar off -e '.[dev]'
	touch $@

chaos: $(VENV)/ready  ## the reliability scoreboard, CHAOS="--rows 1,11 --seed 7"
	$(BIN)/python -m tests.chaos $(CHAOS)

recording: $(VENV)/ready  ## ten minutes at a robot's rates, compared with what was published; RECORDING="--seconds 60 --seed 7"
	$(BIN)/python -m tests.rates $(RECORDING)

hunt: $(VENV)/ready  ## random calls on REEM and on a dict, ten minutes; HUNT="--seed 7 --minutes 30"
	$(BIN)/python -m tests.hunt $(HUNT)

watching: $(VENV)/ready  ## 100,000 random changes by four processes beside watchers of all kinds; WATCHING="--seed 7 --kill --cluster"
	$(BIN)/python -m tests.watchmodel $(WATCHING)

slots: $(VENV)/ready  ## a million uses of slots of shared memory, and a million early updates, by processes that are killed; SLOTS="--seed 7"
	$(BIN)/python tests/slots.py $(SLOTS)
	$(BIN)/python tests/earlysoak.py $(SLOTS)

week: $(VENV)/ready  ## a robot's week in an hour: programs, recorder, page and server fail at random; WEEK="--seed 7 --events 100"
	$(BIN)/python tests/robotweek.py $(WEEK)

mcap: $(VENV)/ready  ## recordings, read by the TypeScript implementation of MCAP that Foxglove uses; needs npm
	npm install --silent --no-fund --no-audit --no-package-lock --prefix tests/mcapcheck
	$(BIN)/python -m tests.mcapcheck

bench: .venv-bench/ready  ## every benchmark, about twenty minutes; BENCH=--quick for about three
	.venv-bench/bin/python -m benchmarks $(BENCH)

bench-recorder: .venv-bench/ready  ## what a recorder costs the writers beside it, 14 to 40 minutes
	.venv-bench/bin/python -m benchmarks.recorder

scale: .venv-bench/ready  ## cost per operation, and docs/lab/scale.md from it, under four minutes; SCALE=--quick
	.venv-bench/bin/python -m benchmarks.scale $(SCALE)

.venv-bench/ready: pyproject.toml
	$(PYTHON) -m venv .venv-bench
	.venv-bench/bin/python -m pip install --quiet --disable-pip-version-check -e '.[bench]'
	touch $@

clean:  ## remove the virtual environment and caches
	rm -rf $(VENV) .venv-bench .venv-floors dist out .mypy_cache .pytest_cache .ruff_cache .hypothesis
