# Everything a fresh machine needs: Python 3.11 to 3.13, and `make demo` or `make test`. On Windows call it from Git's bash.
VENV := .venv
ifeq ($(OS),Windows_NT)
PYTHON ?= python
BIN := $(VENV)/Scripts
else
PYTHON ?= python3
BIN := $(VENV)/bin
endif
# files and pipes are UTF-8 on Windows too
export PYTHONUTF8 := 1
# compiled modules are kept, or each of the many processes that tests start compiles them anew
export PYTHONDONTWRITEBYTECODE :=
OUT ?= runs/demo
# What tests need. One that is skipped because an extra is missing fails, but on Linux for ARM, where pycolmap has no wheel.
ifeq ($(shell uname -sm),Linux aarch64)
EXTRAS ?= dev,formats,ray,view
else
EXTRAS ?= dev,formats,poses,ray,view
export WARPGS_EXTRAS_INSTALLED := 1
endif

.PHONY: demo install lint types docs docs-links docs-run test test-slow test-fault test-browser test-cuda release clean

# LOCKED=1: only files whose hashes stand in requirements.lock; else, from wherever pip is told, the versions of constraints.txt
$(VENV)/installed: pyproject.toml constraints.txt requirements.lock
	@echo "installing into $(VENV): a few minutes, 3 to 8 GB"
	$(PYTHON) -m venv $(VENV)
ifdef LOCKED
	$(BIN)/python -m pip install --quiet --require-hashes --no-deps --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
else
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[$(EXTRAS)]'
endif
	touch $@

install: $(VENV)/installed

# The demo scene, fitted on whatever device is there. A second call starts over.
demo: install
	rm -rf $(OUT)
	mkdir -p $(OUT)
	$(BIN)/warpgs demo $(OUT)/scene
	$(BIN)/warpgs fit $(OUT)/scene --split llff:6 --out $(OUT)/run
	@echo "images: $(OUT)/run/renders    report: $(OUT)/run/report.html"
	@echo "for the commands above, first: source $(BIN)/activate"

# Everything that must pass before a change is offered; `make test ROOM=io` runs the tests of one folder. PYTEST are the words of one
# pytest run.
PYTEST := $(BIN)/python -m pytest -q

UNMARKED := -n 2 --dist worksteal -m "not slow and not fault and not browser and not cuda"
ifdef ROOM
test: install
	$(PYTEST) $(UNMARKED) tests/$(ROOM)
else
test: lint types docs
	$(BIN)/python -m coverage erase
	$(PYTEST) $(UNMARKED) --cov --cov-config=pyproject.toml --cov-report=term:skip-covered --cov-fail-under=93
endif

# Style and the import layers.
lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

# The public names and the examples under strict rules.
types: install
	$(BIN)/mypy
	$(if $(wildcard examples),$(BIN)/mypy examples)

# The documents as a site in site/; a broken link, an unknown formula or any other warning fails. docs-links asks the network, too.
docs: install
	$(BIN)/python -m sphinx --quiet --fail-on-warning --keep-going --builder html docs site

docs-links: install
	$(BIN)/python -m sphinx --quiet --builder linkcheck docs site/links

# The commands and snippets of the README and of all pages, in temporary folders with a small scene.
docs-run: install
	$(BIN)/python -m tools.run_docs

# Run these before a change is called done: CONTRIBUTING.md says which one when. Properties get more examples here;
# `make test-fault FUZZ=200000` gives the readers that many damaged files (2000 where nothing is said).
test-slow test-fault test-browser test-cuda: test-%: install
	$(PYTEST) -m $*
	$(if $(filter slow,$*),$(PYTEST) -m "not slow and not cuda" --hypothesis-profile=many $(PROPERTIES))
PROPERTIES := $(addprefix tests/,numerics/test_properties.py numerics/test_extreme_training.py io/test_splits.py export/test_ply.py)

# The wheel and the sdist, in dist/.
release: install
	rm -rf dist
	$(BIN)/python -m hatchling build
	@echo "to install: pip install dist/*.whl"

clean:
	rm -rf dist runs site .coverage .pytest_cache .ruff_cache .mypy_cache
