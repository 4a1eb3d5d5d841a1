# One command to do each thing. `make help` lists them.
#
# Everything that has to be installed goes into .venv (and .venv-peers for the comparisons), everything that is
# built into target/. Paths are relative, so a checkout may live in a folder with a space in its name.

SHELL := bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:

# The interpreter that .venv is made of: the first one of these that is 3.11, 3.12 or 3.13 (MuJoCo 3.3.7 has no
# wheel for later ones) and can make virtual environments. `make PYTHON=/path/to/python3 ...` decides otherwise.
PYTHON ?= $(shell tools/find-python 3.11 3.13)
# LeRobot 0.6.1 wants 3.12 or later.
PEER_PYTHON ?= $(shell tools/find-python 3.12 3.13)

# The pages are tested in Chromium where there is one, and in continuous integration (CI=true) always.
BROWSER := $(or $(ACTRM_CHROMIUM),$(shell command -v chromium || command -v chromium-browser || command -v google-chrome))

CARGO := cargo
CARGO_FLAGS := --release --locked
# cmake (HDF5 is built from source) comes from .venv; pip must not look outside the lock file's hashes.
export PATH := $(CURDIR)/.venv/bin:$(PATH)
# the scripts and tests look for programs in target/
unexport CARGO_TARGET_DIR
PIP := pip install --disable-pip-version-check --no-input --quiet --require-hashes --no-deps

.PHONY: help
help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' Makefile | sed -E 's/:.*## /\t/' | awk -F'\t' '{ printf "  make %-15s %s\n", $$1, $$2 }'

# ---- what has to be there -------------------------------------------------------------------------------------

.venv/.complete: tools/harness/requirements.lock
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11, 3.12 or 3.13 with venv found; name one: make PYTHON=/path/to/python3 $(MAKECMDGOALS)" >&2; exit 1; }
	@echo "Python: making .venv from $< (about a minute)"
	@rm -rf .venv && "$(PYTHON)" -m venv .venv
	@.venv/bin/python -m $(PIP) -r $<
	@touch $@

# One package has no wheel: it is built with the lock's setuptools.
.venv-libero/.complete: tools/harness/libero.lock
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11, 3.12 or 3.13 with venv found; name one: make PYTHON=/path/to/python3 $(MAKECMDGOALS)" >&2; exit 1; }
	@echo "Python: making .venv-libero from $< (two minutes, 2 GB)"
	@rm -rf .venv-libero && "$(PYTHON)" -m venv .venv-libero
	@sed -n '/^setuptools==/,/[^\\]$$/p' $< > .venv-libero/setuptools.lock
	@.venv-libero/bin/python -m $(PIP) -r .venv-libero/setuptools.lock
	@.venv-libero/bin/python -m $(PIP) --no-build-isolation -r $<
	@touch $@

.venv-peers/.complete: benches/peers/requirements.lock
	@test -n "$(PEER_PYTHON)" || { echo "error: LeRobot 0.6.1 needs Python 3.12 or 3.13 and none was found; name one: make PEER_PYTHON=/path/to/python3 $(MAKECMDGOALS)" >&2; exit 1; }
	@echo "Python: making .venv-peers from $< (torch and LeRobot: some minutes, several GB)"
	@rm -rf .venv-peers && "$(PEER_PYTHON)" -m venv .venv-peers
	@.venv-peers/bin/python -m $(PIP) -r $<
	@touch $@

# NVIDIA's compiler and libraries, for a machine without a CUDA toolkit.
.venv-cuda/.complete: tools/cuda/requirements.lock
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11, 3.12 or 3.13 with venv found; name one: make PYTHON=/path/to/python3 $(MAKECMDGOALS)" >&2; exit 1; }
	@echo "Python: making .venv-cuda from $< (a minute, 1.7 GB)"
	@rm -rf .venv-cuda && "$(PYTHON)" -m venv .venv-cuda
	@.venv-cuda/bin/python -m $(PIP) -r $<
	@tools/cuda/toolkit.sh .venv-cuda
	@touch $@

# What the wheel is built with.
.venv-wheel/.complete: crates/python/requirements.lock
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11, 3.12 or 3.13 with venv found; name one: make PYTHON=/path/to/python3 $(MAKECMDGOALS)" >&2; exit 1; }
	@rm -rf .venv-wheel && "$(PYTHON)" -m venv .venv-wheel
	@.venv-wheel/bin/python -m $(PIP) -r $<
	@touch $@

.venv-docs/.complete: tools/site/requirements.lock
	@test -n "$(PYTHON)" || { echo "error: no Python 3.11, 3.12 or 3.13 with venv found; name one: make PYTHON=/path/to/python3 $(MAKECMDGOALS)" >&2; exit 1; }
	@rm -rf .venv-docs && "$(PYTHON)" -m venv .venv-docs
	@.venv-docs/bin/python -m $(PIP) -r $<
	@touch $@

.PHONY: venv
venv: .venv/.complete ## Python with robosuite, in .venv

.PHONY: libero
libero: .venv-libero/.complete ## Python with LIBERO, in .venv-libero

.PHONY: build
build: .venv/.complete ## the programs, in target/release
	@$(CARGO) build $(CARGO_FLAGS) --workspace --all-targets

# What the demonstration runs, and no more: no tests, no benchmarks, no SQL.
.PHONY: programs
programs: .venv/.complete
	@$(CARGO) build $(CARGO_FLAGS) -p actrm-data -p actrm-zoo -p control

# Another toolkit: make cuda CUDA_HOME=/usr/local/cuda. Cards of this compute capability (8.0: A100) and later ones run the program.
OWN_CUDA := $(CURDIR)/.venv-cuda/cuda
CUDA_HOME ?= $(OWN_CUDA)
CUDA_COMPUTE_CAP ?= 80

.PHONY: cuda
cuda: .venv/.complete $(if $(filter $(OWN_CUDA),$(CUDA_HOME)),.venv-cuda/.complete) ## actrm-zoo for NVIDIA's GPUs, in target/cuda/release (docs/howto/gpu.md)
	@export CUDA_HOME="$(CUDA_HOME)" CUDA_COMPUTE_CAP=$(CUDA_COMPUTE_CAP) PATH="$(CUDA_HOME)/bin:$$PATH"; \
	    for target in "--bin actrm-zoo" "--example gpu_check"; do \
	      $(CARGO) rustc $(CARGO_FLAGS) --target-dir target/cuda -p actrm-zoo --features cuda $$target -- \
	        -C link-arg=-Wl,-rpath,"$(CUDA_HOME)/lib" -C link-arg=-Wl,-rpath,"$(CUDA_HOME)/lib64"; \
	    done

# ---- the main job ---------------------------------------------------------------------------------------------

.PHONY: demo
demo: demo-cost programs ## the whole line: demonstrations, data set, training, evaluation, leaderboard (in out/demo)
	@tools/demo.sh

# Said before anything is built.
.PHONY: demo-cost
demo-cost:
	@echo "make demo takes about 12 minutes on two idle cores the first time (9 to compile, 3 to run), then 3, and 6 GB of disk."

.PHONY: wheel
wheel: .venv/.complete .venv-wheel/.complete ## the Python package, with the programs in it, in target/wheels
	@$(CARGO) build $(CARGO_FLAGS) -p actrm-data -p actrm-zoo -p control -p python
	@.venv-wheel/bin/python tools/build_wheel.py

.PHONY: zoo
zoo: build ## every policy on every robot task, three trainings each, and the leaderboard (hours; goes on where it was)
	@RAYON_NUM_THREADS=1 target/release/actrm-zoo study studies/policies.toml --jobs $(or $(JOBS),2)
	@target/release/actrm-zoo leaderboard

.PHONY: study-recursion
study-recursion: build ## does recursion help: the studies of robot policies, as far as they have not been run (days)
	@for study in recursion towers; do RAYON_NUM_THREADS=1 target/release/actrm-zoo study studies/$$study.toml --jobs $(or $(JOBS),2); done

.PHONY: check
check: build ## the tests of one change, in five minutes: unit tests, the rules of the house, the whole line once
	@$(CARGO) test $(CARGO_FLAGS) --workspace --lib
	@$(CARGO) test $(CARGO_FLAGS) --workspace --test e2e -- architecture:: house:: help:: main_line:: bad_data:: bad_zoo::

# Python's tests run beside Rust's, because neither keeps two cores busy; what they print comes at the end. Rust's have
# priority: they take longest, and many of them use one core only.
.PHONY: test
test: build wheel ## every test: Rust, Python and end to end
	@nice -n 3 tools/test_wheel.sh >target/test_wheel.log 2>&1 & wheel=$$!; \
	    nice -n 3 .venv/bin/python -m pytest -q -n auto --maxprocesses 8 --dist worksteal tools/harness/tests >target/test_harness.log 2>&1 & harness=$$!; \
	    failed=0; $(CARGO) test $(CARGO_FLAGS) --workspace --no-fail-fast || failed=1; \
	    if [ -n "$(BROWSER)$${CI:-}" ]; then \
	      $(CARGO) test $(CARGO_FLAGS) --workspace --test many_rows --test e2e -- --ignored || failed=1; \
	    else echo "not run: the tests of the pages in a browser (no Chromium on the PATH; ACTRM_CHROMIUM names one)"; fi; \
	    wait $$harness || failed=1; wait $$wheel || failed=1; cat target/test_harness.log target/test_wheel.log; exit $$failed

# With clippy's driver as the workspace's compiler (.ci/run) the build is the lint, and nothing is compiled for it alone.
CLIPPY := $(if $(RUSTC_WORKSPACE_WRAPPER),build $(CARGO_FLAGS) --workspace --all-targets,clippy $(CARGO_FLAGS) --workspace --all-targets -- -D warnings)
.PHONY: lint
lint: .venv/.complete ## formatting and lints, Rust and Python
	@$(CARGO) fmt --all --check
	@rustfmt --edition 2024 --check tools/*/src/commands/*.rs # a macro names these modules, and fmt does not see them
	@$(CARGO) $(CLIPPY)
	@.venv/bin/python -m ruff check tools benches tests crates/python
	@.venv/bin/python -m ruff format --check tools benches tests crates/python
	@.venv/bin/python -m basedpyright --project tools/harness --pythonpath .venv/bin/python
	@.venv/bin/python -m basedpyright --project crates/python --pythonpath .venv/bin/python

.PHONY: reference
reference: build ## write docs/reference/*.md from the code (tests check that they are current); docs/reference/python.md: tools/python_api.py
	@ACTRM_REFERENCE=write $(CARGO) test $(CARGO_FLAGS) --workspace --test e2e -- the_reference_of

.PHONY: docs
docs: .venv-docs/.complete ## the documentation as a site that can be searched, in out/site
	@.venv-docs/bin/python tools/site/build.py

# ---- beside the others ----------------------------------------------------------------------------------------

.PHONY: bench
bench: build wheel .venv-peers/.complete ## our speed beside the peers', measured in one run (table, target/bench/*.json)
	@tools/bench.sh

.PHONY: study-puzzles
study-puzzles: build ## the puzzle study, as far as it has not been run (hours), and its page, docs/results/puzzles.md
	@RAYON_NUM_THREADS=1 target/release/actrm-zoo study --page docs/results/puzzles.md

# other files, and more of them: make campaign MUTATIONS=20000 SEED=7
MUTATIONS ?= 2000
SEED ?= 1
KILLS ?= 50
FLIPS ?= 100000
FAULTS ?= all
.PHONY: campaign
campaign: build ## hours of damage: mutated files, flipped bits, kills and faults at every call (MUTATIONS= SEED= KILLS= FLIPS= FAULTS=)
	@ACTRM_MUTATIONS=$(MUTATIONS) ACTRM_MUTATION_SEED=$(SEED) ACTRM_FLIPS=$(FLIPS) ACTRM_FLIP_SEED=$(SEED) \
	    $(CARGO) test $(CARGO_FLAGS) --workspace --no-fail-fast --test hostile --test hostile_videos --test flips
	@$(CARGO) test $(CARGO_FLAGS) --workspace --test puzzles -- --ignored
	@ACTRM_KILLS=$(KILLS) ACTRM_FAULTS=$(FAULTS) $(CARGO) test $(CARGO_FLAGS) --workspace --test e2e -- killed:: faults::

.PHONY: bench-memory
bench-memory: build ## memory that converting a 3 GB image file takes (needs 6 GB of disk; target/bench/memory.json)
	@target/release/examples/bench_memory

.PHONY: interop
interop: build wheel .venv-peers/.complete ## LeRobot, robomimic and other readers, from PyPI, open what we write and the other way round; Ray runs shards
	@.venv-peers/bin/python tests/interop/run.py

.PHONY: references
references: build .venv-peers/.complete ## LeRobot and robomimic train on our demonstrations, our harness judges (an hour alone)
	@tools/references.sh

.PHONY: clean
clean: ## remove everything built, installed or collected: target, all .venv*, out with its demonstrations
	@rm -rf target .venv .venv-libero .venv-peers .venv-wheel .venv-cuda .venv-docs out
