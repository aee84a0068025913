# Everything a fresh machine needs: Python 3.11 to 3.13, and `make demo` or `make test`.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
OUT ?= runs/demo

.PHONY: demo test audit lint clean install

$(VENV)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet --constraint constraints.txt torch
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

install: $(VENV)/installed

# The demo scene, fitted on whatever device is there. A second call starts over.
demo: install
	rm -rf $(OUT)
	mkdir -p $(OUT)
	$(BIN)/warpgs demo $(OUT)/scene | tee $(OUT)/next.txt
	$(BIN)/warpgs fit $(OUT)/scene --split "$$($(BIN)/python -c 'from warpgs.synthetic.demo import split_spec; print(split_spec(24))')" --out $(OUT)/run
	@echo "pictures: $(OUT)/run/renders    report: $(OUT)/run/report.html"

test: install lint
	$(BIN)/python -m coverage erase
	$(BIN)/python -m pytest -q -n 2 -m "not slow and not cuda and not audit" --cov --cov-config=pyproject.toml --cov-report=term:skip-covered --cov-fail-under=90

audit: install
	$(BIN)/python -m pytest -q -m audit

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-cache

clean:
	rm -rf runs .coverage .pytest_cache .ruff_cache
