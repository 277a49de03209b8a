# Needs make and Python 3.10 or later, nothing else: all the rest goes into .venv.

PYTHON ?= python3

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/stamp
# -qq leaves errors only.
PIP := $(BIN)/python3 -m pip -qq --disable-pip-version-check

# The versions that were tested are those of one Python; on others pip chooses.
TESTED := $(BIN)/python3 -c 'import sys; print("-cconstraints.txt" * (sys.version_info[:2] == (3, 11)))'

# What decides on the dependencies, and what is installed with the package. Directories are among
# the latter because a deleted file changes nothing else.
DECLARATION := setup.py setup.cfg constraints.txt constraints-oldest.txt
SOURCES := package.xml LICENSE $(shell find $(wildcard bags config foxglove launch meshes resource rviz \
    scripts spacerobot_ros urdf) -not -path bags -not -path '*/__pycache__*' -not -name '.*')

# The environment has a ROS 2 of its own, which one that the shell has sourced would be mixed with.
ifdef AMENT_PREFIX_PATH
unexport LD_LIBRARY_PATH
endif
unexport AMENT_PREFIX_PATH PYTHONPATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
# Tests start a hundred interpreters, and pytest rewrites every test: bytecode is written once.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.SUFFIXES:

.PHONY: help
help: ## show this list
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/  make \1\t\2/p' Makefile | expand -t 20

.PHONY: demo
demo: $(STAMP)/demo ## fly sliding_masses, the paper's way, and the fast way by the nodes; see out/
	@mkdir -p out
	@rm -f out/sliding_masses_paper.mcap out/sliding_masses.mcap
	$(BIN)/spacerobot run sliding_masses --method lie_bracket --bag out/sliding_masses_paper.mcap
	$(BIN)/spacerobot run sliding_masses --nodes --bag out/sliding_masses.mcap
	$(BIN)/spacerobot report out/sliding_masses.mcap --beside out/sliding_masses_paper.mcap

# Nodes in real time may fail beside other tests: those that fail are run once more, alone. A test
# that hangs fails with the stacks of its threads.
PYTEST := $(BIN)/python3 -m pytest --timeout 600
AGAIN := $(PYTEST) --last-failed --last-failed-no-failures none

.PHONY: test
test: $(STAMP)/test ## check style and types, run the tests
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	@# Types are checked on one core while the other compiles the tests, once for all workers, which
	@# would compile each of them side by side. A third worker has the cores while tests in real
	@# time wait for their clock.
	@$(BIN)/mypy >$(STAMP)/mypy.txt 2>&1 & types=$$!; \
	    $(BIN)/python3 -m pytest --collect-only -qq >$(STAMP)/collected.txt 2>&1; \
	    $(PYTEST) -n 3 || $(AGAIN); tests=$$?; \
	    wait $$types; types=$$?; cat $(STAMP)/mypy.txt; exit $$((tests | types))

.PHONY: test-slow
test-slow: $(STAMP)/test ## run the slow tests: long flights and plans, nodes in real time, pages of the documentation
	$(PYTEST) -m "slow and not study" -n 3 --dist loadfile --durations=20 || \
	    $(AGAIN) -m "slow and not study"

# With TESTED and VENV given here, the rules below make another environment.
.PHONY: test-oldest
test-oldest: ## run the quick tests with the versions of Ubuntu 24.04, in .venv-oldest; PYTHON=python3.12: its Python
	@$(MAKE) --no-print-directory VENV=.venv-oldest TESTED='echo -cconstraints-oldest.txt' .venv-oldest/stamp/test
	@.venv-oldest/bin/python3 --version
	@.venv-oldest/bin/python3 -m pip freeze | grep -iE '^($(subst $() ,|,$(OLDEST)))=='
	nice .venv-oldest/bin/python3 -m pytest -n 1 -p no:cacheprovider

OLDEST := click lxml lz4 matplotlib numpy pin pyarrow pyparsing PyYAML scipy zstandard

.PHONY: gpu
gpu: $(STAMP)/gpu ## run the tests of lanes, campaigns and environments on a CUDA device; print its ticks per second
	$(BIN)/python3 -m pytest -m gpu

# The wheel carries axe-core's script; what it depends on is not needed.
AXE := axe-playwright-python==0.1.8
$(STAMP)/axe.min.js: | $(STAMP)/test
	@$(PIP) download --no-deps --dest $(STAMP) $(AXE)
	@$(BIN)/python3 -m zipfile -e $(STAMP)/axe_playwright_python-*.whl $(STAMP)/axe
	@cp $(STAMP)/axe/axe_playwright_python/axe.min.js $@
	@rm -rf $(STAMP)/axe $(STAMP)/axe_playwright_python-*.whl

.PHONY: known-errors
known-errors: $(STAMP)/test ## put each known error into the package; the tests must notice it; ONLY=WORD: some
	PYTHONPATH=test $(BIN)/python3 -m support.known_errors $(if $(ONLY),"$(ONLY)")

.PHONY: expected
expected: $(STAMP)/test ## write what the tests expect of parameters and plans anew, where a change is wanted
	PYTHONPATH=.:test $(BIN)/python3 -m support.expected

STUDIES := $(shell sed -n 's/^\([a-z-]*\):$$/\1/p' test/studies.yaml)
STUDY := PYTHONPATH=.:test nice $(BIN)/python3 -m support.studies

.PHONY: studies $(STUDIES)
studies: $(STAMP)/test ## list the studies of test/studies.yaml: make NAME COUNT=.. SEED=.. ONLY=..
	@$(STUDY)

accessibility: $(STAMP)/axe.min.js
$(STUDIES): $(STAMP)/test
	COUNT="$(COUNT)" SEED="$(SEED)" ONLY="$(ONLY)" ROSDISTRO="$(ROSDISTRO)" $(STUDY) $@

.PHONY: bench
bench: $(STAMP)/bench ## measure what users wait for, in processor time; AGAINST=PATH: in turns with another checkout; ONLY=WORD: some
	$(BIN)/python3 -m pytest benchmarks -q --benchmark-columns=median,iqr,rounds --benchmark-sort=fullname \
	    $(if $(AGAINST),--against=$(AGAINST)) $(if $(ONLY),-k "$(ONLY)")

.PHONY: real-time
real-time: $(STAMP)/bench ## fly ten minutes in real time in separate processes, at 100, then 200 and 500 Hz
	$(BIN)/python3 benchmarks/real_time.py deadlines 600 100
	$(BIN)/python3 benchmarks/real_time.py deadlines 60 200 500

SOAK ?= 1800
.PHONY: soak
soak: $(STAMP)/bench ## fly half an hour (SOAK=SECONDS) in separate processes: memory, descriptors, threads; out/soak.png
	$(BIN)/python3 benchmarks/real_time.py soak $(SOAK) out

# Short flights to near goals at low rates, so that the bags of all scenarios stay small.
REFERENCE := --set plant.marker_period=5 --set plant.diagnostics_period=5
FLY = @fly() { echo "bags/$$1.mcap"; rm -f "bags/$$1.mcap"; $(BIN)/spacerobot run "$$@" --bag "bags/$$1.mcap" $(REFERENCE) \
    >/dev/null; }; fly
NEAR := --goal 0.12 0.05 -0.03 --goal-rotvec 0.02 -0.03 0.06 \
    --end-effector-goal 1.76 0.12 0.5 0.02 0.70964 0.02998 0.70365 \
    --set coordinated_control.settle_time=0.5 \
    --set coordinated_control.position_tolerance=0.002 --set coordinated_control.attitude_tolerance=0.01 \
    --set plant.tick_rate=50 --set coordinated_control.tick_rate=50
STRAIGHT := --set coordinated_control.profile=quintic

.PHONY: bags
bags: $(STAMP)/demo ## fly the reference bags in bags/ again, where a changed behaviour is wanted
	$(FLY) sliding_masses --method lie_bracket --goal 0.05 -0.04 0.02 0 0 0 1 --goal-rotvec 0.04 -0.02 0.03 \
	    --set plant.tick_rate=10 --set planner.tick_rate=10 --set planner.lie_bracket.t1=10 \
	    --set planner.lie_bracket.cycle_period=4 --set planner.lie_bracket.cycles=0 \
	    --set planner.attitude_tolerance=1e-4
	$(FLY) arm_attitude --goal-rotvec 0.01 0.01 0.01 --set planner.attitude_tolerance=0.006 \
	    --set plant.tick_rate=5 --set planner.tick_rate=5
	$(FLY) planar_chain --set plant.tick_rate=25 --set planner.tick_rate=25 \
	    --set coordinated_control.tick_rate=25
	$(FLY) coordinated_control --set coordinated_control.settle_time=0.5 \
	    --set coordinated_control.position_tolerance=0.02 \
	    --set coordinated_control.attitude_tolerance=0.02
	$(FLY) servicer $(NEAR)
	$(FLY) servicer_thrusters $(NEAR) $(STRAIGHT) --set coordinated_control.position_tolerance=0.006 \
	    --set coordinated_control.transposed_jacobian.joint_damping=0
	$(FLY) free_flyer --goal 0.8 0.2 0.05 --goal-rotvec 0 0 1 --set plant.tick_rate=10 \
	    --set coordinated_control.tick_rate=10 --set coordinated_control.settle_time=0.5 $(STRAIGHT) \
	    --set plant.world=config/worlds/panel.urdf --set coordinated_control.world=config/worlds/panel.urdf
	$(FLY) inspection --set plant.tick_rate=5 --set coordinated_control.tick_rate=5 \
	    --set coordinated_control.settle_time=0.5 --set plant.world=config/worlds/satellite.urdf \
	    --set coordinated_control.world=config/worlds/satellite.urdf
	$(FLY) wheels --set plant.tick_rate=10 --set coordinated_control.tick_rate=10 \
	    --set coordinated_control.settle_time=1
	$(FLY) gravity_gradient --set plant.tick_rate=12.5 --set coordinated_control.tick_rate=12.5 \
	    --set coordinated_control.settle_time=0.5 --set coordinated_control.position_tolerance=1e-3 \
	    --set coordinated_control.attitude_tolerance=1e-3
	$(FLY) reach
	$(FLY) two_hands
	$(FLY) strut --set plant.world=config/worlds/strut.urdf --set planner.world=config/worlds/strut.urdf
	$(FLY) capture --set plant.target.robot=config/targets/block.urdf
	$(FLY) servicing $(STRAIGHT) --set coordinated_control.target.horizon=120 \
	    --set plant.target.robot=config/targets/satellite.urdf \
	    --set plant.tick_rate=10 --set coordinated_control.tick_rate=10

# What mkdocs prints of its theme's successor is no warning of the build.
.PHONY: docs
docs: $(STAMP)/docs ## build the documentation site; see out/docs/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/python3 -m mkdocs build --strict --quiet
	@echo "out/docs/index.html"

.PHONY: figures
figures: $(STAMP)/docs ## compute the numbers of the documents again: docs/figures.json
	$(BIN)/python3 -m docs_build.figures
	$(BIN)/python3 -m docs_build.singularities
	$(BIN)/python3 -m docs_build.integration

.PHONY: reference
reference: $(STAMP)/docs ## write the references of parameters, topics and commands again: reference/
	$(BIN)/python3 -m docs_build.clone

.PHONY: animation
animation: $(STAMP)/demo ## fly the satellite of the documents' first picture and draw it again: docs/images/turning.gif
	$(BIN)/python3 -m docs_build.animation

.PHONY: structure
structure: ## count lines, modules and unclear words of the package; AGAINST=PATH: of another checkout too
	@$(PYTHON) -m docs_build.structure $(AGAINST)

.PHONY: words
words: ## draw names and texts of the package at random, to judge whether they are understood; SEED=1
	@$(PYTHON) -m docs_build.structure --sample $(SEED)

.PHONY: clean
clean: ## remove .venv, caches, the site, and the demo's bag and report
	rm -rf $(VENV) .venv-oldest build/lib build/bdist.* spacerobot_ros.egg-info
	rm -rf .hypothesis .mypy_cache .pytest_cache .ruff_cache
	rm -rf out/docs
	rm -f out/sliding_masses.mcap out/sliding_masses_paper.mcap out/sliding_masses.html
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
	@rmdir build out 2>/dev/null || true

$(STAMP)/venv:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null || { \
	    echo "$(PYTHON) is not a Python 3.10 or later; name one: make PYTHON=python3.12" >&2; \
	    exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || { \
	    echo "$(PYTHON) cannot make a virtual environment;" \
	    "install its venv module (Debian, Ubuntu: apt install python3-venv)." >&2; \
	    exit 1; }
	@echo "Creating $(VENV) (once) ..."
	@$(PYTHON) -m venv --clear $(VENV)
	@$(PIP) install 'setuptools>=70.1'
	@mkdir -p $(STAMP)
	@touch $@

$(STAMP)/demo: EXTRAS := jazzy,viewer,collision,pytest
$(STAMP)/test: EXTRAS := jazzy,test
$(STAMP)/gpu: EXTRAS := jazzy,test,cuda
$(STAMP)/bench: EXTRAS := jazzy,campaign,bench
$(STAMP)/docs: EXTRAS := jazzy,docs

# A changed declaration or a new stamp: the package with its dependencies. Changed sources: the
# package alone. What is left in build/lib would be installed again, deleted files too.
$(STAMP)/demo $(STAMP)/test $(STAMP)/gpu $(STAMP)/bench $(STAMP)/docs: $(DECLARATION) $(SOURCES) | $(STAMP)/venv
	@rm -rf build/lib
	@echo "Installing spacerobot_ros[$(EXTRAS)] into $(VENV)$(if $(ALL), (once; a minute or two)) ..."
	@$(PIP) install --no-build-isolation \
	    $(if $(ALL),$$($(TESTED)) '.[$(EXTRAS)]',--no-deps --force-reinstall .)
	@rm -rf build/lib build/bdist.* spacerobot_ros.egg-info
	@rmdir build 2>/dev/null || true
	@touch $@

ALL = $(filter $(DECLARATION),$?)
