# Two commands on a fresh machine with Python 3.10+ and nothing else: `make demo` and `make test`.
PYTHON ?= python3
VENV   ?= .venv
ifeq ($(OS),Windows_NT)
BIN := $(VENV)/Scripts
else
BIN := $(VENV)/bin
endif
# One thread each: two torch threads on a busy two-core machine are about ten times slower than one.
export OMP_NUM_THREADS := 1
export HF_HUB_OFFLINE := 1
ifdef PIP_FIND_LINKS
export UV_FIND_LINKS := $(PIP_FIND_LINKS)
endif
# INDEX=https://download.pytorch.org/whl/cpu spares a Linux machine without a GPU gigabytes of CUDA.
INSTALL = $(BIN)/uv pip install -q --python $(BIN)/python \
  $(if $(INDEX),--extra-index-url $(INDEX) --index-strategy unsafe-best-match)

.PHONY: demo test quick lint notebooks clean

$(BIN)/uv:
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q uv

$(VENV)/.runtime: pyproject.toml constraints.txt | $(BIN)/uv
	$(INSTALL) -e . -c constraints.txt
	@touch $@

$(VENV)/.dev: pyproject.toml constraints.txt | $(BIN)/uv
	$(INSTALL) -e ".[dev]" -c constraints.txt
	@touch $@ $(VENV)/.runtime

demo: $(VENV)/.runtime  ## three sentences, three motions: an HTML player and a GIF each
	$(BIN)/minicmdm demo --out demo --force

test: $(VENV)/.dev  ## lint, tests and notebooks
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pytest -n 2 --dist loadgroup -rs
	MINICMDM_FAST=1 $(BIN)/pytest -n 2 --nbmake notebooks --nbmake-timeout=90

quick: $(VENV)/.dev  ## tests alone, without the browser
	$(BIN)/pytest -n 2 --dist loadgroup -m "not browser"

lint: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

notebooks: $(VENV)/.dev  ## render every notebook at full size and store its outputs
	$(BIN)/python notebooks/render.py

clean:
	rm -rf $(VENV) demo runs
