# Two commands: `make demo` and `make test`. Each sets up everything it needs in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check

.PHONY: demo test quick check lint format setup clean help

help:
	@echo "make demo    set up and run EC-SLAM on the built-in studio"
	@echo "make test    set up, lint, type-check and run every test"
	@echo "make quick   the tests that take under three minutes"
	@echo "make format  format the code"

demo: $(VENV)/.ready
	$(BIN)/ecslam demo $(DEMO)

test: $(VENV)/.ready-dev lint
	$(BIN)/python -m pytest --durations=10

quick: $(VENV)/.ready-dev lint
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow and not browser"

check lint: $(VENV)/.ready-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@if [ -e $(BIN)/mypy ]; then set -x; $(BIN)/mypy ecslam && $(BIN)/mypy app; else \
		echo "Types are not checked: that takes Python 3.11, for the numpy whose types they fit"; fi

format: $(VENV)/.ready-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

setup: $(VENV)/.ready

# pip, not python: where the system lacks a part of venv, that leaves a python without one.
$(BIN)/pip:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || (echo "Python 3.10 or newer is needed; name it with: make PYTHON=python3.11 ..." && exit 1)
	$(PYTHON) -m venv $(VENV)

# torch first, so that a CPU build which satisfies the pins is kept.
$(VENV)/.ready: pyproject.toml | $(BIN)/pip
	@echo "Setting up $(VENV) (a few minutes the first time) ..."
	$(PIP) "torch>=2.10,<2.14" \
		|| (echo "torch could not be installed. If there is none for this Python, name another: make clean, then make PYTHON=python3.13 ..." && exit 1)
	$(PIP) -e .
	@echo "Compiling the kernels for this machine ..."
	@$(BIN)/ecslam run "synthetic/studio?size=80x60&frames=8&noise=1" --preset live --headless --out $(VENV)/first-run >$(VENV)/first-run.log \
		|| (cat $(VENV)/first-run.log && exit 1)
	@touch $@

$(VENV)/.ready-dev: pyproject.toml $(VENV)/.ready
	$(PIP) -e ".[dev,oracles]"
	@touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache
