# `make demo` and `make test` set up everything they need in .venv. What the checks are stands in .ci/run.
PYTHON ?= python3
export PYTHON
VENV := .venv
BIN := $(VENV)/$(if $(filter Windows_NT,$(OS)),Scripts,bin)
DEMO := demo

.PHONY: setup demo test test-all test-browser test-gpu-build fuzz lint types docs packages check release clean

setup test lint types docs packages:
	@.ci/run $@

# What a contributor runs before each commit is `test`; this adds the tests that take minutes.
test-all:
	@.ci/run test slow

# The tiles in CesiumJS, in headless Chromium without a network: needs chromium and npm.
test-browser:
	@.ci/run browser

# The kernels of the cuda backend compile, with the compilers of the package index; needs no GPU.
test-gpu-build:
	@.ci/run gpu-build

check:
	@.ci/run

# A simulated flight, the whole pipeline on it, and what the check points say. The files of control points state no σ:
# the options are those that the simulator drew its errors with.
demo: setup
	$(BIN)/georef simulate $(DEMO)/survey --images 24 --size 480x360 --sigma-survey 0.01 --force
	$(BIN)/georef run $(DEMO)/workspace --images $(DEMO)/survey/images \
		--trajectory $(DEMO)/survey/trajectory.csv --vertical ellipsoidal \
		--gcp $(DEMO)/survey/gcp_list.txt --checkpoints $(DEMO)/survey/checkpoints.txt \
		--sigma-gcp-h 0.01 --sigma-gcp-v 0.01 --sigma-mark 0.2 --preset fast --deliver raster,report
	@echo "The splat:      $(DEMO)/workspace/export/splat.ply (and splat.ply.georef.json beside it)"
	@echo "The orthophoto: $(DEMO)/workspace/raster/orthophoto.tif"
	@echo "The report:     open $(DEMO)/workspace/report/report.html in a browser"
	@echo "The viewer:     $(BIN)/georef view $(DEMO)/workspace"

# Mutated files for every reader, for an hour or FUZZ_SECONDS; a finding is printed with the case that repeats it.
fuzz: setup
	$(BIN)/python -m tests.fuzz

# `make release VERSION=0.2.0`: checks, version, changelog, commit, tag, packages. Nothing is pushed.
release: setup
	$(BIN)/python .ci/release.py $(VERSION)

clean:
	rm -rf $(VENV) $(DEMO) build dist site .cache .coverage *.egg-info
