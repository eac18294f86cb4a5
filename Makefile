# Everything runs in an environment of its own: a fresh machine needs Python 3.11 or newer and make.
#
#   make demo        the heat kernel signature of a real brain slice: pictures in demo/
#   make test        the tests
#   make test-slow   the tests that take minutes
#   make test-optimised   tests of the numerical core, compiled as users have it
#   make stress      random problems against independent answers, an hour of them
#   make lint        lint, format and type checks
#   make notebooks   run every notebook
#   make docs        the documentation site, in site/
#   make browser     Chromium, by apt-get, for the tests of the page to explore, which are skipped without
#   make clean       remove what the above made

PYTHON ?= python3
VENV ?= .venv
# Test processes. Each compiles for itself, so more than there are cores do not pay.
JOBS ?= auto
# As many BLAS threads as cores in each of them, or for each of eight virtual devices, would fight for the cores.
ONE_THREAD := OPENBLAS_NUM_THREADS=1

BIN := $(VENV)/bin
# A stamp is newer than pyproject.toml as long as what it names is installed: nothing is installed twice.
STAMPS := $(VENV)/.stamps
BRAIN := mdt==1.2.7
# What rounding and the order of operations reach first: solvers, factorisations and derivatives.
CORE := $(patsubst %,tests/test_%.py,eigenpairs block_lanczos derivatives float32)

.PHONY: browser demo test test-slow test-optimised stress lint notebooks docs clean
.DELETE_ON_ERROR:

demo: $(STAMPS)/dti $(STAMPS)/brain
	$(BIN)/python -m hks_jax demo -o demo

test: $(STAMPS)/test
	$(ONE_THREAD) $(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not slow"

test-slow: $(STAMPS)/test
	$(ONE_THREAD) $(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m slow

# The other tests are compiled with hardly an optimisation; an empty XLA_FLAGS leaves them all on.
test-optimised: $(STAMPS)/test
	XLA_FLAGS= $(ONE_THREAD) $(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m "not slow" $(CORE)

stress: $(STAMPS)/test
	$(ONE_THREAD) $(BIN)/python -m tests.stress --json benchmarks/results/stress.json

lint: $(STAMPS)/lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

notebooks: $(STAMPS)/dti $(STAMPS)/brain
	@set -e; for notebook in notebooks/*.py; do \
	    test -e "$$notebook" || { echo "no notebooks"; break; }; \
	    echo "$$notebook"; MPLBACKEND=Agg $(ONE_THREAD) $(BIN)/python "$$notebook"; \
	done

# Not --quiet: what is not printed is not counted, and the build would pass with broken links.
docs: $(STAMPS)/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# The only target that installs anything outside $(VENV), and so none needs it.
browser:
	@if command -v chromium || command -v chromium-browser || command -v google-chrome; then :; \
	elif apt-get update -qq && DEBIAN_FRONTEND=noninteractive apt-get install -qq -y --no-install-recommends chromium >/dev/null; then :; \
	else echo "note: Chromium could not be installed; the tests in a browser are skipped" >&2; fi

clean:
	rm -rf $(VENV) demo site build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(STAMPS)/venv:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	    { echo "error: $(PYTHON) is missing or older than 3.11; choose another: make PYTHON=python3.12 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' || \
	    { echo "error: $(PYTHON) lacks venv or ensurepip; on Debian and Ubuntu: apt install python3-venv" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@mkdir -p $(STAMPS) && touch $@

# One extra of pyproject.toml each: dti, test, lint, docs.
$(STAMPS)/dti $(STAMPS)/test $(STAMPS)/lint $(STAMPS)/docs: $(STAMPS)/%: pyproject.toml $(STAMPS)/venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[$*]"
	@touch $@

# A brain to show, and no dependency: a phantom takes its place where it cannot be had. It is tried again next time.
$(STAMPS)/brain: $(STAMPS)/venv
	@if $(BIN)/python -m pip install --quiet --disable-pip-version-check --retries 1 --no-deps "$(BRAIN)"; then touch $@; \
	else echo "note: $(BRAIN), which carries the example brain, could not be installed; a phantom takes its place" >&2; fi
