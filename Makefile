# make run    calibrate on the shipped recording, train on the result, deploy on the simulated reactor, report
# make test   style, types, and the tests to run after each change: a few minutes
# make verify   style, types and all tests
# make coverage   which share of each package's lines the last `PYTEST_ADDOPTS=--cov make verify` executed
# make docs   the pages and the API reference as a site, build/docs/index.html, whole without a network; a warning is an error
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
EXTRAS := dev,bench,sweep,docs
unexport PYTHONDONTWRITEBYTECODE  # else every process compiles the project, and pytest its tests, anew

ROOMS := conf dqn envs experiments hardware $(sort $(patsubst %/,%,$(dir $(wildcard experiments/*/*.py hardware/*/*.py))))

.PHONY: run test verify lint coverage docs clean
.DELETE_ON_ERROR:

$(STAMP): pyproject.toml constraints.txt
	@echo "Setting up $(VENV), once: Python packages of 1.7 GB, one to three minutes."
	@$(PYTHON) -c 'import sys; sys.exit("error: Python %d.%d is too old: allowed 3.11 and newer; make PYTHON=python3.11" % sys.version_info[:2] if sys.version_info < (3, 11) else 0)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	@echo "$(VENV) is ready; use it in a terminal with: . $(BIN)/activate"
	@touch $@

run: $(STAMP)
	$(BIN)/python -m experiments.demo

lint: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: $(STAMP) lint
	$(BIN)/python -m pytest

verify: $(STAMP) lint
	$(BIN)/python -m pytest -m 'not campaign'

coverage:
	@for room in $(ROOMS); do \
	  printf '%-28s %4s %%\n' $$room $$($(BIN)/python -m coverage report --include="$$room/*" --format=total); done

docs: $(STAMP)
	$(BIN)/python -m sphinx -W --keep-going -q docs build/docs
	@echo "the pages: build/docs/index.html"

clean:
	rm -rf $(VENV) runs .coverage .pytest_cache .mypy_cache .ruff_cache build docs/api *.egg-info
