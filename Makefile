# `make` lists the targets. Nothing needs to be installed before but Python 3.12 or newer (with its headers) and make;
# where there is no C++ compiler, one comes with the packages.

PYTHON ?= $(shell for p in python3.12 python3.13 python3.14 python3; do \
	command -v $$p >/dev/null 2>&1 && $$p -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null \
	&& { echo $$p; break; }; done)
BIN := .venv/bin
TOOLS := .venv/tools
READY := .venv/ready
CORE := $(wildcard core/*.cpp core/*.hpp core/*.cmake core/backend.py core/CMakeLists.txt core/editable/CMakeLists.txt)
PIP := $(BIN)/python -m pip install --disable-pip-version-check --constraint constraints.txt
COMPILER := { [ -n "$$CXX" ] || command -v c++ || command -v g++ || command -v clang++; } >/dev/null
C := $(wildcard src/echogrid/microcontroller/c/*.[ch] tests/microcontroller/*.c benchmarks/microcontroller/*.c)

.DEFAULT_GOAL := help
.PHONY: help setup map test slow check format bench study paper generalise drivable peers docs mrpt weights builds sanitize arm clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## /{printf "make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

$(TOOLS): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "make: found no Python 3.12 or newer, expected one on the PATH (or PYTHON=...)"; exit 2; }
	@echo "make: setting up .venv, once: about 1 GB of packages, a few minutes"
	$(PYTHON) -m venv .venv
	@$(COMPILER) || echo "make: found no C++ compiler (c++, g++, clang++): zig builds the core (package ziglang, 100 MB, minutes)"
	$(PIP) scikit-build-core nanobind cmake ninja $$($(COMPILER) || echo ziglang)
	@touch $(TOOLS)

$(READY): $(TOOLS) $(CORE)
	@echo "make: installing what is missing and building the core"
	$(PIP) --no-build-isolation --editable $(if $(filter $(TOOLS),$?),'.[dev]',. --no-deps)
	@touch $(READY)
	@echo "make: .venv is ready; the command is .venv/bin/echogrid, or echogrid after: . .venv/bin/activate"

setup: $(READY)  ## make the virtual environment .venv

map: $(READY)  ## map the shipped sample into out/ (look at out/map.png, or out/map.html in a browser)
	@echo "make: mapping the shipped sample, 521 scans of a B21, into out/ (some seconds)"
	$(BIN)/echogrid map --view --out out

test: $(READY)  ## run the tests (7 to 9 minutes on 2 cores)
	@echo "make: running the tests, 7 to 9 minutes on 2 cores"
	$(BIN)/python -m pytest

slow: $(READY)  ## run the tests that take a minute each, which make test leaves out
	$(BIN)/python -m pytest -m slow

check: $(READY)  ## lint, format and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/ty check
	$(BIN)/clang-format --dry-run --Werror core/*.cpp core/*.hpp tests/core/*.cpp $(C)

format: $(READY)  ## put the code into shape
	$(BIN)/ruff check --fix
	$(BIN)/ruff format
	$(BIN)/clang-format -i core/*.cpp core/*.hpp tests/core/*.cpp $(C)

bench: $(READY)  ## speed and memory (about 16 minutes; python -m benchmarks.live hour takes 8 more)
	$(BIN)/python -m benchmarks.simulator
	$(BIN)/python -m benchmarks.mapping
	$(BIN)/python -m benchmarks.models
	$(BIN)/python -m benchmarks.memory
	$(BIN)/python -m benchmarks.bags
	$(BIN)/python -m benchmarks.core
	$(BIN)/python -m benchmarks.mrpt
	$(BIN)/python -m benchmarks.decision
	$(BIN)/python -m benchmarks.live latency
	$(BIN)/python -m benchmarks.live start
	$(BIN)/python -m benchmarks.microcontroller

study: $(READY)  ## score both networks and the cone on held-out rooms (about 10 minutes)
	$(BIN)/python -m experiments.paper.held_out --resolution 0.04 set-network network cone

paper: $(READY)  ## the paper's figures, every model beside the network, and docs/results.md (about 30 minutes)
	$(BIN)/python -m experiments.paper.figures_2_3_4
	$(BIN)/python -m experiments.paper.figure_5
	$(BIN)/python -m experiments.paper.beams
	$(BIN)/python -m experiments.paper.figures_6_to_9
	$(BIN)/python -m experiments.paper.corridor8_map
	$(BIN)/python -m experiments.paper.ablation & ablation=$$!; \
	$(BIN)/python -m experiments.paper.held_out --record held_out && \
	$(BIN)/python -m experiments.paper.held_out --robot p3dx --rooms 8 --record held_out_p3dx && wait $$ablation
	$(BIN)/python -m benchmarks.models --record
	$(BIN)/python -m experiments.paper.results

peers:  ## install what tests use and skip without: rosbag, Fast DDS, Chromium, ARM (Debian packages, as root or sudo)
	tests/peers/install.sh

docs: $(READY)  ## build the documentation site into build/site
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

mrpt:  ## build the MRPT peers for make paper and make bench (Debian packages, as root or through sudo)
	benchmarks/mrpt/install.sh

generalise: $(READY)  ## measure the set network on rooms, arrays and physics it has not seen (about 20 minutes)
	$(BIN)/python -m experiments.studies.generalise

drivable: $(READY)  ## measure whether maps can be driven on: doors, many passes, walls, flights (about 40 minutes)
	$(BIN)/python -m experiments.studies.drivable

weights: $(READY)  ## train the weights that ship (about an hour and a half on 2 cores)
	$(BIN)/echogrid train --robot any --out src/echogrid/weights/set.npz
	$(BIN)/echogrid train --network paper --robot any --drives 6000 --epochs 24 --out src/echogrid/weights/any.npz

builds: $(READY)  ## try the builds of the core that take long: sdist, wheel, a machine without compiler (10 minutes)
	$(BIN)/python -m pytest -n 0 tests/core/builds.py

sanitize: $(READY)  ## run the tests of the core under the sanitizers of addresses and undefined behaviour (a minute)
	PATH="$(CURDIR)/$(BIN):$$PATH" core/sanitize.sh

arm: $(READY)  ## build the wheel for aarch64 with zig and run the tests of the core on it in qemu (minutes)
	PATH="$(CURDIR)/$(BIN):$$PATH" core/arm.sh

clean:  ## remove the virtual environment and everything made
	rm -rf .venv out build dist .pytest_cache .ruff_cache .hypothesis src/echogrid/_core*.so
	find core/editable -mindepth 1 ! -name CMakeLists.txt -delete
