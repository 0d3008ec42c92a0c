# `make demo` and `make test` set up everything they need in .venv.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
DEMO := demo

.PHONY: setup demo test lint types check clean

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

# A simulated flight, the whole pipeline on it, and what the check points say.
demo: setup
	$(BIN)/georef simulate $(DEMO)/survey --images 24 --size 480x360 --force
	$(BIN)/georef run $(DEMO)/workspace --images $(DEMO)/survey/images \
		--trajectory $(DEMO)/survey/trajectory.csv --vertical ellipsoidal \
		--gcp $(DEMO)/survey/gcp_list.txt --checkpoints $(DEMO)/survey/checkpoints.txt \
		--preset fast --iterations 1500 --max-image-size 480
	$(BIN)/georef status $(DEMO)/workspace
	$(BIN)/georef evaluate $(DEMO)/workspace
	@echo "The splat: $(DEMO)/workspace/export/splat.ply (and splat.ply.georef.json beside it)"

test: setup
	$(BIN)/python -m pytest

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: setup
	$(BIN)/mypy

check: test lint types

clean:
	rm -rf $(VENV) $(DEMO) build dist *.egg-info
