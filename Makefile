# Everything a fresh machine needs: `make job`, `make test`. `make help` lists the rest.
SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help

JOB ?= jobs/cpl_lab.yaml
ARGS ?=
VENV := .venv
BLENDER := .venv-blender
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --no-input
# More than one test at a time, each in one thread; those of a file share what they need, so they stay together.
# The files keep the order of tests/conftest.py, which begins with the longest.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder
# Slow tests wait for processes of their own half of the time: one more of them than there are cores.
SLOW := $(subst -n logical,-n $(shell expr $$(getconf _NPROCESSORS_ONLN) + 1),$(PYTEST))
COMPILE := $(BIN)/uv pip compile --quiet --generate-hashes --no-emit-index-url --custom-compile-command "make lock"
LOCK := $(COMPILE) --universal --python-version 3.11 --fork-strategy fewest pyproject.toml --group build

.PHONY: help
help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)
	@echo "  JOB=FILE.yaml chooses the job (default $(JOB)), ARGS='--out DIR ...' adds flags to it."

.PHONY: setup
setup: $(VENV)/.project ## make .venv from requirements.lock and install bodycap into it

.PHONY: job
job: $(VENV)/.project ## run a job: make job JOB=jobs/cpl_lab.yaml
	$(BIN)/bodycap run $(JOB) $(ARGS)

.PHONY: watch
watch: $(VENV)/.project ## work on every folder of videos dropped into jobs/inbox (Ctrl-C stops it, it goes on later)
	$(BIN)/bodycap watch jobs/inbox $(ARGS)

.PHONY: test
test: $(VENV)/.dev ## run the fast tests
	$(PYTEST) $(ARGS)

.PHONY: test-slow
test-slow: $(VENV)/.dev ## run the slow tests and those on real captures
	.ci/system-packages --browser
	$(SLOW) -m "slow or data" --durations=20 $(ARGS)

.PHONY: fuzz
fuzz: $(VENV)/.dev ## give 72,000 broken inputs to the readers of jobs, BVH files, calibrations and telemetry
	BODYCAP_FUZZ_SHARE=1 $(PYTEST) -m slow tests/unit/test_fuzz.py tests/unit/telemetry/test_gopro.py $(ARGS)

.PHONY: test-cluster
test-cluster: $(VENV)/.dev ## run jobs on a Dask scheduler and workers of this machine, killing some
	$(BIN)/python -m pytest -m cluster tests/cluster $(ARGS)

.PHONY: test-blender
test-blender: $(VENV)/.dev $(BLENDER)/.ready ## import the results into Blender; pictures in build/blender
	BODYCAP_BLENDER=$(abspath $(BLENDER))/bin/python OMP_NUM_THREADS=1 \
		$(BIN)/python -m pytest -m blender tests/blender $(ARGS)

.PHONY: lint
lint: $(VENV)/.dev ## check format, lint and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy --strict

.PHONY: check
check: lint test ## lint, types and the fast tests

.PHONY: docs
docs: $(VENV)/.docs ## build the documentation into build/docs (offline; a warning is an error)
	$(BIN)/python -m sphinx -b html -W --keep-going -q docs build/docs
	@echo "documentation: $(abspath build/docs/index.html)"

.PHONY: bench
bench: $(VENV)/.dev ## measure exactness and speed on the captures (slow)
	$(BIN)/python -m tests.bench $(ARGS)

.PHONY: test-fresh
test-fresh: ## run `make job` and `make test` in a new, minimal Debian 12 (root; needs debootstrap)
	.ci/test-fresh $(ARGS)

.PHONY: lock
lock: $(VENV)/.dev ## resolve the dependencies anew into the locks
	$(LOCK) --output-file requirements.lock
	$(LOCK) --extra formats --extra cluster --extra web --extra viewer --constraints requirements.lock \
		--output-file requirements-extras.lock
	$(LOCK) --group dev --extra formats --extra cluster --extra web --extra viewer --constraints requirements-extras.lock \
		--output-file requirements-dev.lock
	$(LOCK) --group docs --constraints requirements-dev.lock --output-file requirements-docs.lock
	$(COMPILE) --universal --python-version 3.11 --group blender --output-file requirements-blender.lock

.PHONY: extras
extras: $(VENV)/.extras ## install what USD, C3D, the cluster, the live page and Rerun need

.PHONY: blender
blender: $(BLENDER)/.ready ## install Blender as a Python module (for FBX files; Python 3.11 only)

.PHONY: clean
clean: ## delete the environment, caches and results
	rm -rf $(VENV) $(BLENDER) build dist out .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find bodycap_batch tests examples -name __pycache__ -prune -exec rm -rf {} +

# Stamps: a re-run with nothing changed does nothing. The project itself cannot be part of a hash-checked
# install, so it follows without dependencies, built by the backend the lock brought. It is compiled like what
# pip installs: where Python is told to write no bytecode (containers), each stage's process would compile it anew.
$(VENV)/.created: .ci/system-packages
	.ci/system-packages
	"$$(.ci/system-packages --python)" -m venv $(VENV)
	touch $@

$(VENV)/.run: $(VENV)/.created requirements.lock
	$(PIP) install --quiet --require-hashes -r requirements.lock
	touch $@

$(VENV)/.project: $(VENV)/.run pyproject.toml
	$(PIP) install --quiet --no-deps --no-build-isolation --editable .
	$(BIN)/python -m compileall -q bodycap_batch
	touch $@

$(VENV)/.extras: $(VENV)/.project requirements-extras.lock
	$(PIP) install --quiet --require-hashes -r requirements-extras.lock
	touch $@

$(BLENDER)/.ready: $(VENV)/.created requirements-blender.lock
	"$$(PYTHON=$${PYTHON:-python3.11} .ci/system-packages --python)" -m venv $(BLENDER)
	$(BLENDER)/bin/python -m pip --disable-pip-version-check --no-input install --quiet --require-hashes -r requirements-blender.lock
	touch $@

$(VENV)/.docs: $(VENV)/.project requirements-docs.lock
	$(PIP) install --quiet --require-hashes -r requirements-docs.lock
	touch $@

$(VENV)/.dev: $(VENV)/.project requirements-dev.lock
	$(PIP) install --quiet --require-hashes -r requirements-dev.lock
	touch $@
