.DEFAULT_GOAL := help
.PHONY: help setup demo kernels test test-all test-page slow bench bench-page rig-demo rig-faults rig-wall-clock rig-families rig-ros fuzz fuzz-ros robustness validation accuracy controllers studies tracker steering far-targets worlds space worlds-space tuning docs lint clean

export PIP_DISABLE_PIP_VERSION_CHECK := 1
BIN := .venv/bin
CORE := .venv/.core
STAMP := .venv/.installed
PIP = $(BIN)/python -m pip install --quiet --no-compile --editable
# True for an interpreter that runs, fits, and can make a virtual environment.
FITS := -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' >/dev/null 2>&1

help:  ## show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1\t\2/p' $(MAKEFILE_LIST) | expand -t 14

$(CORE): pyproject.toml
	@if ! $(BIN)/python $(FITS); then \
	  for python in $(PYTHON) python3 python3.13 python3.12 python3.11 none; do \
	    if $$python $(FITS); then break; fi; \
	  done; \
	  if [ $$python = none ]; then \
	    echo "make: no Python 3.11, 3.12 or 3.13 with venv found; name one with PYTHON=/path/to/python" >&2; \
	    exit 1; \
	  fi; \
	  echo "Making .venv with $$($$python --version)" >&2; \
	  $$python -m venv --clear .venv; \
	fi
	@echo "Installing flexneedle into .venv" >&2
	@$(PIP) .
	@touch $@

setup: $(STAMP)  ## install the package with its extras and tools into .venv (PYTHON=… chooses the interpreter)

$(STAMP): $(CORE)
	@echo "Installing extras and tools into .venv" >&2
	@$(PIP) '.[dev]'
	@touch $@

demo: $(CORE)  ## plan and steer one insertion on the phantom
	@$(BIN)/flexneedle insert phantom --seed 0

kernels: setup  ## compile the kernels, once before the tests start in several processes
	@$(BIN)/python -c "from flexneedle.phantom.kernels import compile_kernels; compile_kernels(1); compile_kernels(2)"

test: kernels  ## run the tests but the long ones, on all cores
	$(BIN)/python -m pytest -n auto --dist worksteal $(PYTEST_ARGS)

test-all: kernels  ## run all tests but the slow ones and the page's: statistics over many draws, studies in several processes
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow and not page" $(PYTEST_ARGS)

test-page: kernels  ## test the page in a browser; needs chromium on the path (SCREENSHOTS=folder keeps pictures)
	$(BIN)/python -m pytest -n auto --dist worksteal -m "page and not slow" tests/lab/page $(PYTEST_ARGS)

bench: setup  ## measure speed: mechanics, the exact plant, control periods, ten million rows of tracker data, 60 s of an emulated tracker, round trips to emulated motors, ROS topics
	$(BIN)/python benchmarks/bench.py
	$(BIN)/python benchmarks/plant.py
	$(BIN)/python benchmarks/periods.py
	$(BIN)/python benchmarks/em.py
	$(BIN)/python benchmarks/aurora.py
	$(BIN)/python benchmarks/galil.py
	$(BIN)/python benchmarks/ros.py
	$(BIN)/python benchmarks/ros_stop.py

bench-page: setup  ## measure the page in a browser against its bars; needs chromium on the path (half an hour; ARGS=--quick)
	$(BIN)/python benchmarks/page.py $(ARGS)

rig-demo: setup  ## insertions on an emulated rig over both protocols in real time (N=1)
	$(BIN)/python campaigns/rig_demo.py --insertions $(or $(N),1) --out $(or $(DIR),runs/rig-demo)

rig-faults: setup  ## faults injected into running insertions on an emulated rig, 20 times each, and the table of docs/safety.md (an hour and more)
	$(BIN)/python campaigns/rig_faults.py --out $(or $(DIR),runs/rig-faults)

rig-wall-clock: setup  ## 150 pairs of insertions on an emulated rig, each decision 0, 50 and 150 ms longer (hours)
	$(BIN)/python campaigns/rig_wall_clock.py --out $(or $(DIR),runs/rig-wall-clock)

rig-families: setup  ## insertions on 100 random rigs, emulated and in simulated time (hours)
	$(BIN)/python campaigns/rig_families.py --out $(or $(DIR),runs/rig-families)

rig-ros: setup  ## cost of ROS subscribers for an insertion on an emulated rig, and stops over ROS (an hour)
	$(BIN)/python campaigns/rig_ros.py --pairs 5 --out $(or $(DIR),runs/rig-ros)

fuzz: setup  ## a million random and damaged inputs each to the readers of the Galil, the Aurora and rig files
	$(BIN)/python campaigns/fuzz_galil.py
	$(BIN)/python campaigns/fuzz_aurora.py
	$(BIN)/python campaigns/fuzz_rig_file.py

fuzz-ros: setup  ## a million random and damaged messages to the readers of ROS topics, and to a running node
	$(BIN)/python campaigns/fuzz_ros.py

robustness: setup  ## 100,000 random insertions of the model in the plane and in space, as it ships and adapted, and 2,000 of the exact plant (long)
	$(BIN)/python studies/robustness.py
	$(BIN)/python studies/robustness.py --space
	$(BIN)/python studies/robustness.py --adapted
	$(BIN)/python studies/robustness.py --space --adapted
	$(BIN)/python studies/plant_robustness.py

validation: setup  ## compare the exact plant with closed forms and a second solver; writes docs/validation.md
	$(BIN)/python studies/validation.py

accuracy: setup  ## the paper's experiment, 150 insertions with the exact plant, and its report (DIR=runs/accuracy)
	$(BIN)/flexneedle study phantom --resume --out $(or $(DIR),runs/accuracy)
	$(BIN)/flexneedle report $(or $(DIR),runs/accuracy)

controllers: setup  ## every controller on the same phantoms, and the report (DIR=runs/controllers; long)
	$(BIN)/flexneedle study controllers --resume --out $(or $(DIR),runs/controllers)
	$(BIN)/flexneedle report $(or $(DIR),runs/controllers)

studies: setup  ## 15,000 insertions with other plants, guides and needles, and their reports (two hours)
	for study in phantom-published odd-targets mismatch mismatch-doubled imperfections guide-distance gauges; do \
	  $(BIN)/flexneedle study $$study --resume --out runs/$$study && \
	  $(BIN)/flexneedle report runs/$$study || exit 1; \
	done
	$(BIN)/python studies/worst.py runs/mismatch-doubled --out docs/images

tracker: setup  ## compare the simulated tracker with the paper's tables; its estimators, its monitor, and insertions with it (long)
	$(BIN)/python studies/environments.py
	$(BIN)/python studies/em_coverage.py
	$(BIN)/flexneedle study tracker --resume --out runs/tracker
	$(BIN)/flexneedle report runs/tracker
	$(BIN)/python studies/monitor.py

steering: setup  ## steering plans on 100 random worlds, replayed on the exact plant
	$(BIN)/python studies/steering.py

far-targets: setup  ## plans to targets up to the edge of the reach, near the skin and deep, of 40 random worlds
	$(BIN)/python studies/far_targets.py

worlds: setup  ## 200 random worlds in three cases with four controllers, and the report (DIR=runs/worlds; hours)
	$(BIN)/flexneedle study worlds --resume --out $(or $(DIR),runs/worlds)
	$(BIN)/flexneedle report $(or $(DIR),runs/worlds)

space: setup  ## insertions in space with three drivers and four controllers, and the report (DIR=runs/space; hours)
	$(BIN)/flexneedle study space --resume --out $(or $(DIR),runs/space)
	$(BIN)/flexneedle report $(or $(DIR),runs/space)

worlds-space: setup  ## 200 random worlds in space, each with every driver, and the report (DIR=runs/worlds-space; hours)
	$(BIN)/flexneedle study worlds-space --resume --out $(or $(DIR),runs/worlds-space)
	$(BIN)/flexneedle report $(or $(DIR),runs/worlds-space)

tuning: setup  ## tune each controller with 200 insertions; writes studies/tuning (long)
	for method in ce-mpc bevel-only resolved-rate broyden-mpc; do \
	  $(BIN)/python studies/tune.py $$method || exit 1; \
	done

slow: kernels  ## the longest tests: a thousand insertions against the reference, every fault of a device, examples of the docs
	$(BIN)/python -m pytest -n auto --dist worksteal -m slow $(PYTEST_ARGS)

docs: setup  ## build the documentation site into site/; warnings are errors
	$(BIN)/python tools/docs/scenario_reference.py
	$(BIN)/python tools/docs/rig_reference.py
	$(BIN)/python tools/docs/command_reference.py
	$(BIN)/python tools/docs/rig_states.py
	PYTHONPATH=tools/docs $(BIN)/zensical build --strict --clean

lint: setup  ## style, types, layers, words
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tools/lint/words.py

clean:  ## remove what make and the tools made
	rm -rf .venv dist build site .cache .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
