# `make` lists the targets. Nothing needs to be installed before but Python 3.12 or newer and make.

PYTHON ?= $(shell for p in python3.12 python3.13 python3.14 python3; do \
	command -v $$p >/dev/null 2>&1 && $$p -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null \
	&& { echo $$p; break; }; done)
BIN := .venv/bin
READY := .venv/ready

.DEFAULT_GOAL := help
.PHONY: help setup map test check format bench study weights clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## /{printf "make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(READY): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "make: found no Python 3.12 or newer, expected one on the PATH (or PYTHON=...)"; exit 2; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[dev]'
	@touch $(READY)

setup: $(READY)  ## make the virtual environment .venv

map: $(READY)  ## map the shipped sample into out/ (look at out/map.png)
	$(BIN)/echogrid map --out out

test: $(READY)  ## run the tests
	$(BIN)/python -m pytest

check: $(READY)  ## lint, format and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/ty check

format: $(READY)  ## put the code into shape
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

bench: $(READY)  ## speed and memory (about 3 minutes)
	$(BIN)/python benchmarks/simulator.py
	$(BIN)/python benchmarks/mapping.py
	$(BIN)/python benchmarks/memory.py

study: $(READY)  ## score the network and the cone on held-out rooms (about 4 minutes)
	$(BIN)/python experiments/held_out.py

weights: $(READY)  ## train the weights that ship (about 10 minutes on 2 cores)
	$(BIN)/echogrid train --robot any --drives 6000 --epochs 24 --out src/echogrid/weights/any.npz

clean:  ## remove the virtual environment and everything made
	rm -rf .venv out build dist .pytest_cache .ruff_cache .hypothesis
