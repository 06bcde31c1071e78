# Every target sets up .venv from nothing when it is not there. Needs python 3.11 or newer.
# A CPU-only torch: PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu make test

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
BENCHMARKS := $(sort $(wildcard benchmarks/bench_*.py))

.PHONY: demo test lint bench

demo: $(READY)
	$(BIN)/capsule-vio demo --out out/demo

test: lint
	$(BIN)/pytest -n 2

lint: $(READY)
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: $(READY)
	@set -e; for script in $(BENCHMARKS); do echo "== $$script"; $(BIN)/python "$$script"; done

$(READY): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "python 3.11 or newer is needed, $(PYTHON) is older: make PYTHON=python3.11"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --upgrade pip
	$(BIN)/python -m pip install "torch>=2.6,<2.14"
	$(BIN)/python -m pip install --editable ".[sim]" --group dev
	@touch $@
