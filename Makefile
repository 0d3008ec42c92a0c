# `make demo` and `make test` set up everything they need in .venv. What the checks are stands in .ci/run.
PYTHON ?= python3
export PYTHON
VENV := .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
DEMO := demo

.PHONY: setup demo test test-browser fuzz lint types docs check release clean

setup test lint types docs:
	@.ci/run $@

# The tiles in CesiumJS, in headless Chromium without a network: needs chromium and npm.
test-browser:
	@.ci/run browser

check:
	@.ci/run

# A simulated flight, the whole pipeline on it, and what the check points say.
demo: setup
	$(BIN)/georef simulate $(DEMO)/survey --images 24 --size 480x360 --force
	$(BIN)/georef run $(DEMO)/workspace --images $(DEMO)/survey/images \
		--trajectory $(DEMO)/survey/trajectory.csv --vertical ellipsoidal \
		--gcp $(DEMO)/survey/gcp_list.txt --checkpoints $(DEMO)/survey/checkpoints.txt \
		--preset fast --iterations 1500 --max-image-size 480
	$(BIN)/georef status $(DEMO)/workspace
	$(BIN)/georef evaluate $(DEMO)/workspace
	$(BIN)/georef report $(DEMO)/workspace
	@echo "The splat: $(DEMO)/workspace/export/splat.ply (and splat.ply.georef.json beside it)"
	@echo "The report: open $(DEMO)/workspace/report/report.html in a browser"
	@echo "The viewer: $(BIN)/georef view $(DEMO)/workspace"

# Mutated files for every reader, for an hour or FUZZ_SECONDS; a finding is printed with the case that repeats it.
fuzz: setup
	$(BIN)/python -m tests.fuzz

# `make release VERSION=0.2.0`: checks, version, changelog, commit, tag. Nothing is pushed.
release: setup
	$(BIN)/python .ci/release.py $(VERSION)

clean:
	rm -rf $(VENV) $(DEMO) build dist site .cache .coverage *.egg-info
