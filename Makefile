# Everything runs in an environment of its own: a fresh machine needs Python 3.11 or newer and make.
#
#   make demo        the heat kernel signature of a real brain slice: pictures in demo/
#   make test        the tests
#   make test-slow   the tests that take minutes
#   make test-optimised   tests of the numerical core, compiled as users have it
#   make test-lowest   a few tests with the lowest versions that pyproject.toml allows
#   make stress      random problems against independent answers, an hour of them
#   make lint        lint, format and type checks
#   make notebooks   run every notebook
#   make docs        the documentation site, in site/
#   make tables      tables and plots of benchmarks/results/, and the list of references, in the pages that show them
#   make dist        wheel and sources, in dist/, built and checked
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
CORE := $(addprefix tests/,$(patsubst %,eigen/test_%.py,eigenpairs block_lanczos derivatives) \
    signatures/test_float32.py fem/test_assembly.py project/test_outermost_derivatives.py)

# What calls the libraries that the package stands on: those for files, jax and scipy, matplotlib, lineax and optimistix.
LIBRARIES := $(addprefix tests/,project/test_import.py io/test_io.py io/test_nrrd.py io/test_mesh_io.py \
    signatures/test_signatures.py::test_hks_and_kernel_against_the_matrix_exponential \
    signatures/test_signatures.py::test_everything_runs_under_jit \
    plot/test_plot.py::test_hks_panels_has_one_panel_and_bar_per_time \
    inverse/test_inverse.py::test_solvers_of_optimistix_are_taken_as_they_are \
    cli/test_cli.py::test_npz_end_to_end_equals_the_library)
LOWEST := $(VENV)/lowest

.PHONY: browser demo test test-slow test-optimised test-lowest stress lint notebooks docs dist tools tables \
    clean
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

# Libraries that are newer than they, and come along, deprecate what they do.
test-lowest: $(STAMPS)/lowest
	$(ONE_THREAD) $(LOWEST)/bin/python -m pytest -n $(JOBS) --dist worksteal -m "not slow" -W ignore::DeprecationWarning $(LIBRARIES)

stress: $(STAMPS)/test
	$(ONE_THREAD) PYTHONPATH=tests $(BIN)/python -m stress --json benchmarks/results/stress.json

lint: $(STAMPS)/lint
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Two at a time, as each leaves a core idle half of its time; compiled as in tests.
notebooks: $(STAMPS)/dti $(STAMPS)/train $(STAMPS)/brain
	export XLA_FLAGS="$$($(BIN)/python tests/compiler_flags.py)" && \
	    printf '%s\n' notebooks/*.py | MPLBACKEND=Agg $(ONE_THREAD) xargs -P 2 -n 1 -t $(BIN)/python

# Not --quiet: what is not printed is not counted, and the build would pass with broken links.
docs: $(STAMPS)/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

tables: $(STAMPS)/test
	$(BIN)/python benchmarks/tables.py
	$(BIN)/python docs/hooks/references.py

# The wheel is built from the sources, so that nothing gets into it that they lack.
dist: $(STAMPS)/dist
	rm -rf dist
	$(BIN)/python -m build --outdir dist
	$(BIN)/twine check --strict dist/*
	$(BIN)/python tests/distribution.py dist

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

# One extra of pyproject.toml each: dti, train, test, lint, docs, dist. That for tests includes the first two.
EXTRAS := $(addprefix $(STAMPS)/,dti train test lint docs dist)
$(EXTRAS): $(STAMPS)/%: pyproject.toml $(STAMPS)/venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[$*]"
	@touch $@ $(if $(filter test,$*),$(STAMPS)/dti $(STAMPS)/train)

# Three extras at once, so that lint, docs and dist can then run beside each other: pip cannot.
tools: $(STAMPS)/venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable ".[lint,docs,dist]"
	@touch $(addprefix $(STAMPS)/,lint docs dist)

# Of what the libraries require in turn, the newest.
$(STAMPS)/lowest: pyproject.toml $(STAMPS)/venv
	$(PYTHON) -m venv --clear $(LOWEST)
	$(BIN)/python tests/floors.py > $(LOWEST)/floors.txt
	$(LOWEST)/bin/python -m pip install --quiet --disable-pip-version-check --constraint $(LOWEST)/floors.txt --editable ".[test]"
	@touch $@

# A brain to show, and no dependency: a phantom takes its place where it cannot be had. It is tried again next time.
$(STAMPS)/brain: $(STAMPS)/venv
	@if $(BIN)/python -m pip install --quiet --disable-pip-version-check --retries 1 --no-deps "$(BRAIN)"; then touch $@; \
	else echo "note: $(BRAIN), which carries the example brain, could not be installed; a phantom takes its place" >&2; fi
