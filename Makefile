.DEFAULT_GOAL := help
.PHONY: help setup demo kernels test test-all test-page quick slow bench compare bench-page rig-demo rig-faults rig-wall-clock rig-families rig-ros fuzz fuzz-ros fuzz-igtl fuzz-fbgs robustness validation accuracy controllers studies tracker steering far-targets plan-reach tilted-skin front calibration rooms sensors wide worlds space worlds-space tuning slicer docs lint clean

export PIP_DISABLE_PIP_VERSION_CHECK := 1
BIN := .venv/bin
CORE := .venv/.core
STAMP := .venv/.installed
PIP = $(BIN)/python -m pip install --quiet --no-compile --editable
# True for an interpreter that runs, fits, and can make a virtual environment.
FITS := -c 'import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' >/dev/null 2>&1

# Targets that run scripts, each with a quick mode.
SCRIPTS := demo bench compare bench-page rig-demo rig-faults rig-wall-clock rig-families rig-ros fuzz fuzz-ros fuzz-igtl fuzz-fbgs robustness validation accuracy controllers studies tracker steering far-targets plan-reach tilted-skin front calibration rooms sensors wide worlds space worlds-space tuning slow docs

comma := ,

# With QUICK=1 each of them does everything that it does, on a few cases, in seconds; results go to a temporary folder.
quick = $(if $(QUICK),$(1))
ifndef RUNS
RUNS := $(if $(QUICK),$(shell mktemp -d),runs)
endif
OUT = $(or $(DIR),$(RUNS)/$@)

# Run a study, and write its report: $(call study,NAME,FOLDER)
define study
$(call quick,$(BIN)/python studies/shorten.py $(1) --out $(RUNS)/$(1).toml)
$(BIN)/flexneedle study $(or $(call quick,$(RUNS)/$(1).toml --workers 1),$(1)) --resume --out $(2)
$(BIN)/flexneedle report $(2)

endef

help:  ## show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/\1\t\2/p' $(MAKEFILE_LIST) | expand -t 16

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
	@$(BIN)/flexneedle insert phantom --seed 0 $(call quick,--out $(OUT))

kernels: setup  ## compile the kernels, once before the tests start in several processes
	@$(BIN)/python -c "from flexneedle.phantom.kernels import compile_kernels; compile_kernels(1); compile_kernels(2)"

test: kernels  ## run the tests but the long ones, on all cores
	$(BIN)/python -m pytest -n auto --dist worksteal $(PYTEST_ARGS)

test-all: kernels  ## run all tests but the slow ones and the page's: statistics over many draws, studies in several processes
	$(BIN)/python -m pytest -n auto --dist worksteal -m "not slow and not page" $(PYTEST_ARGS)

test-page: kernels  ## test the page in a browser; needs chromium on the path (SCREENSHOTS=folder keeps pictures)
	$(BIN)/python -m pytest -n auto --dist worksteal -m "page and not slow" tests/lab/page $(PYTEST_ARGS)

quick: kernels  ## try demo and every target below with few cases, as QUICK=1 does with each of them
	@folder=$$(mktemp -d) && trap 'rm -rf "$$folder"' EXIT && \
	  $(MAKE) --jobs 3 --keep-going --output-sync=target QUICK=1 RUNS="$$folder" $(SCRIPTS)

bench: setup  ## measure speed: commands, mechanics, the exact plant, control periods, ten million rows of tracker data, 60 s of an emulated tracker, round trips to emulated motors, ROS topics, OpenIGTLink, an FBGS stream
	$(BIN)/python benchmarks/bench.py $(call quick,--quick)
	$(BIN)/python benchmarks/waiting.py $(call quick,--quick)
	$(BIN)/python benchmarks/plant.py $(call quick,--phantoms 2)
	$(BIN)/python benchmarks/periods.py $(call quick,--worlds 100120 1)
	$(BIN)/python benchmarks/em.py $(call quick,--rows 2000 --times 1)
	$(BIN)/python benchmarks/aurora.py $(call quick,--quick)
	$(BIN)/python benchmarks/galil.py $(call quick,--quick)
	$(BIN)/python benchmarks/ros.py $(call quick,--periods 20 --stops 3)
	$(BIN)/python benchmarks/ros_stop.py $(call quick,--stops 2)
	$(BIN)/python benchmarks/igtl.py $(call quick,--quick)
	$(BIN)/python benchmarks/fbgs.py $(call quick,--quick)

compare: setup  ## compare the speed of this checkout with another one in pairs (BEFORE=path; an hour)
	$(BIN)/python benchmarks/compare.py --before $(or $(BEFORE),$(call quick,.)) $(call quick,--quick)

bench-page: setup  ## measure the page in a browser against its bars; needs chromium on the path (half an hour)
	$(call quick,@command -v chromium >/dev/null || { echo 'bench-page: NOT TRIED: chromium is not installed' >&2; exit 0; };) \
	  $(BIN)/python benchmarks/page.py $(call quick,--quick)

rig-demo: setup  ## insertions on an emulated rig over both protocols in real time (N=1)
	$(BIN)/python campaigns/rig_demo.py --insertions $(or $(N),1) --out $(OUT) $(call quick,--quick)

rig-faults: setup  ## faults injected into running insertions on an emulated rig, 20 times each, and the table of docs/safety.md (an hour and more)
	$(BIN)/python campaigns/rig_faults.py --out $(OUT) $(call quick,--timings 1 --only Ctrl-C)

rig-wall-clock: setup  ## 150 pairs of insertions on an emulated rig, each decision 0, 50 and 150 ms longer (hours)
	$(BIN)/python campaigns/rig_wall_clock.py --out $(OUT) $(call quick,--quick --pairs 1)

rig-families: setup  ## insertions on 100 random rigs, emulated and in simulated time (hours)
	$(BIN)/python campaigns/rig_families.py --out $(OUT) $(call quick,--first 23 --rigs 1)

rig-ros: setup  ## cost of ROS subscribers for an insertion on an emulated rig, and stops over ROS (an hour)
	$(BIN)/python campaigns/rig_ros.py --out $(OUT) $(or $(call quick,--quick --pairs 1 --stops 1),--pairs 5)

fuzz: setup  ## a million random and damaged inputs each to the readers of the Galil, the Aurora and rig files
	$(BIN)/python campaigns/fuzz_galil.py $(call quick,--inputs 1000)
	$(BIN)/python campaigns/fuzz_aurora.py $(call quick,--inputs 30 --seconds 2)
	$(BIN)/python campaigns/fuzz_rig_file.py $(call quick,--inputs 100)

fuzz-ros: setup  ## a million random and damaged messages to the readers of ROS topics, and to a running node
	$(BIN)/python campaigns/fuzz_ros.py $(call quick,--inputs 100)

fuzz-igtl: setup  ## a million random and damaged OpenIGTLink messages to the decoder, and to a running server
	$(BIN)/python campaigns/fuzz_igtl.py $(call quick,--inputs 1000)

fuzz-fbgs: setup  ## a million random and damaged frames to the decoder of an FBGS stream, and to a connected sensor
	$(BIN)/python campaigns/fuzz_fbgs.py $(call quick,--inputs 1000)

robustness: setup  ## 100,000 random insertions of the model in the plane and in space, as it ships and adapted, and 2,000 of the exact plant (long)
	$(BIN)/python studies/robustness.py $(call quick,--sequences 200)
	$(BIN)/python studies/robustness.py --space $(call quick,--sequences 200)
	$(BIN)/python studies/robustness.py --adapted $(call quick,--sequences 200)
	$(BIN)/python studies/robustness.py --space --adapted $(call quick,--sequences 200)
	$(BIN)/python studies/plant_robustness.py $(call quick,--insertions 5)

validation: setup  ## compare the exact plant with closed forms and a second solver; writes docs/validation.md
	$(BIN)/python studies/validation.py $(call quick,--quick --out $(OUT))

accuracy: setup  ## the paper's experiment, 150 insertions with the exact plant, and its report (DIR=runs/accuracy)
	$(call study,phantom,$(OUT))

controllers: setup  ## every controller on the same phantoms, and the report (DIR=runs/controllers; long)
	$(call study,controllers,$(OUT))

STUDIES := phantom-published odd-targets mismatch mismatch-doubled imperfections guide-distance gauges

studies: setup  ## 15,000 insertions with other plants, guides and needles, and their reports (two hours)
	$(foreach each,$(or $(call quick,mismatch-doubled),$(STUDIES)),$(call study,$(each),$(RUNS)/$(each)))
	$(BIN)/python studies/worst.py $(RUNS)/mismatch-doubled $(or $(call quick,--study $(RUNS)/mismatch-doubled.toml --samples 1),--out docs/images)

tracker: setup  ## compare the simulated tracker with the paper's tables; its estimators, its monitor, and insertions with it (long)
	$(BIN)/python studies/environments.py $(call quick,--seeds 1)
	$(BIN)/python studies/em_coverage.py $(call quick,--sets 10)
	$(call study,tracker,$(RUNS)/tracker)
	$(BIN)/python studies/monitor.py $(call quick,--runs 1 --out $(RUNS)/monitor)

steering: setup  ## steering plans on 100 random worlds, replayed on the exact plant
	$(BIN)/python studies/steering.py $(call quick,--worlds 100000 1)

far-targets: setup  ## plans to targets up to the edge of the reach, near the skin and deep, of 40 random worlds
	$(BIN)/python studies/far_targets.py $(call quick,--worlds 100000 1)

plan-reach: setup  ## plans of 200 random worlds, and what a search of 20 times the size finds where they miss
	$(BIN)/python studies/plan_reach.py $(call quick,--worlds 100000 1 --factor 2)

rooms: setup  ## plans and insertions in random rooms with zones to avoid, and forced faults (hours)
	$(BIN)/python studies/zone_rooms.py plans --larger 20 $(call quick,--count 1 --larger 1)
	$(BIN)/python studies/zone_rooms.py loops --count 250 --draws 3 $(call quick,--count 1)
	$(BIN)/python studies/zone_rooms.py loops --count 25 --sd 0 --displaced 3 --blind $(call quick,--count 1)

tilted-skin: setup  ## insertions where skin and layers are deeper or shallower than planned, as by a tilted skin
	$(BIN)/python studies/tilted_skin.py $(call quick,--worlds 100000 1)

front: setup  ## error against peak tissue energy of five controllers and the oracle on 40 random worlds from soft tissue to stiff gel, with the figure (DIR=runs/front; minutes)
	$(BIN)/python studies/front.py --out $(OUT) $(call quick,--worlds 100000 1 --oracle 1 --samples 16 --iterations 3)

calibration: setup  ## fits of 100 sets of simulated recordings, and 50 closed loops without and with a calibration (half an hour)
	$(BIN)/python studies/calibration.py sets $(call quick,--count 1)
	$(BIN)/python studies/calibration.py loops $(call quick,--count 1)
	$(BIN)/python studies/calibration_sensors.py $(call quick,--count 1)

sensors: setup  ## insertions with sensors along the needle, healthy and faulty, in 140 random worlds (hours)
	$(BIN)/python studies/sensors.py --out $(OUT) $(call quick,--worlds 100001 1 --unguided 0 --rows "lost$(comma) fbg")
	$(BIN)/python studies/sensor_check.py $(call quick,--worlds 100000 1)

wide: setup  ## 200 random worlds from soft tissue to stiff gel with four controllers, and the report (DIR=runs/wide; hours)
	$(call study,wide,$(OUT))

worlds: setup  ## 200 random worlds in three cases with four controllers, and the report (DIR=runs/worlds; hours)
	$(call study,worlds,$(OUT))

space: setup  ## insertions in space with three drivers and four controllers, and the report (DIR=runs/space; hours)
	$(call study,space,$(OUT))

worlds-space: setup  ## 200 random worlds in space, each with every driver, and the report (DIR=runs/worlds-space; hours)
	$(call study,worlds-space,$(OUT))

tuning: setup  ## tune each controller with 200 insertions; writes studies/tuning (long)
	for method in $(or $(call quick,bevel-only),ce-mpc bevel-only resolved-rate broyden-mpc); do \
	  $(BIN)/python studies/tune.py $$method $(call quick,--quick --jobs 1 --out $(OUT)) || exit 1; \
	done

slow: kernels  ## the longest tests: a thousand insertions against the reference, every fault of a device, examples of the docs
	$(BIN)/python -m pytest -m slow $(or $(call quick,tests/simulator/test_reference.py -k test_random_insertions_agree[4-1]),-n auto --dist worksteal) $(PYTEST_ARGS)

slicer: setup  ## check files of images against slicerio and the scene of 3D Slicer, if pip has installed slicerio and slicer-core
	$(BIN)/python tests/lab/images/slicer_by_hand.py

docs: setup  ## build the documentation site into site/; warnings are errors
	$(call quick,mkdir -p $(OUT) && cp -r docs src tools zensical.toml $(OUT))
	$(call quick,cd $(OUT) &&) $(abspath $(BIN))/python tools/docs/scenario_reference.py
	$(call quick,cd $(OUT) &&) $(abspath $(BIN))/python tools/docs/rig_reference.py
	$(call quick,cd $(OUT) &&) $(abspath $(BIN))/python tools/docs/recording_reference.py
	$(call quick,cd $(OUT) &&) $(abspath $(BIN))/python tools/docs/case_reference.py
	$(call quick,cd $(OUT) &&) $(abspath $(BIN))/python tools/docs/command_reference.py
	$(call quick,cd $(OUT) &&) $(abspath $(BIN))/python tools/docs/rig_states.py
	$(call quick,cd $(OUT) &&) PYTHONPATH=tools/docs $(abspath $(BIN))/zensical build --strict --clean

lint: setup  ## style, types, layers, words
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tools/lint/words.py

clean:  ## remove what make and the tools made
	rm -rf .venv dist build site .cache .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
