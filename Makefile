# Everything runs in .venv, which `make install` fills with the exact versions of requirements.lock.
# PYTHON=/path/to/python chooses the interpreter, ARGS="--quick" passes options on.

.DEFAULT_GOAL := help
.PHONY: help install peers engines compile compile-all table3 reports test test-all test-portable test-oldest lint docs lock clean

# one thread: CPU times can be compared, and no BLAS changes a count
export OPENBLAS_NUM_THREADS := 1
export OMP_NUM_THREADS := 1
export MKL_NUM_THREADS := 1
export VECLIB_MAXIMUM_THREADS := 1

# bytecode is kept even where the environment forbids it: without it every process takes seconds to read its modules
unexport PYTHONDONTWRITEBYTECODE

RUN := .venv/bin/python
STAMP := .venv/installed
PIP := -m pip --disable-pip-version-check --quiet
UV := $(RUN) -m uv pip install --quiet --python $(RUN)
CANDIDATES := $(or $(PYTHON),python3 python3.11 python3.12 python3.13 python3.14)
NEEDS := 3.11 to 3.14
FITS := import sys, venv, ensurepip; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 14))

define FIND_PYTHON
python=""; \
for candidate in $(CANDIDATES); do \
	if "$$candidate" -c "$(FITS)" >/dev/null 2>&1; then python="$$candidate"; break; fi; \
done; \
if [ -z "$$python" ]; then \
	echo "twoloop needs Python $(NEEDS) with the module venv; tried: $(CANDIDATES)." >&2; \
	echo "Install one, or name it: make PYTHON=/path/to/python3.11 ..." >&2; \
	exit 1; \
fi
endef

help: ## say what there is
	@awk -F ':.*## ' '/^[a-z0-9-]+:.*## / { printf "make %-13s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))

install: $(STAMP) ## make .venv; runs by itself when it must

# `venv --clear` would empty the environment behind a link, which others may be using
$(STAMP): requirements.lock pyproject.toml
	@if [ -L .venv ]; then \
		echo ".venv is a link to $$(readlink .venv): not cleared. Set that environment up in its own folder, or remove the link." >&2; \
		exit 1; \
	fi
	@$(FIND_PYTHON); \
	echo "[1/3] Making .venv with $$("$$python" --version)"; \
	"$$python" -m venv --clear .venv
	@echo "[2/3] Installing packages"
	@$(RUN) $(PIP) install --no-compile $$(grep '^uv==' requirements.lock) \
		&& $(UV) -r requirements.lock && $(UV) --no-deps --no-build-isolation --editable . \
		|| { echo "Not by uv: by pip, which takes longer" >&2 \
		&& $(RUN) $(PIP) install --no-compile -r requirements.lock \
		&& $(RUN) $(PIP) install --no-compile --no-deps --no-build-isolation --editable .; }
	@touch $@

peers: .venv/peers ## more solvers for work_precision, which does without them: heyoka, CyRK, diffrax, CasADi, extensisq

.venv/peers: requirements-peers.lock $(STAMP)
	@$(RUN) $(PIP) install -c requirements.lock -r requirements-peers.lock
	@touch $@

engines: .venv/engines ## the physics engines of the study engines, where they are installed: MuJoCo, Pinocchio, Drake

.venv/engines: requirements-engines.lock $(STAMP)
	@$(RUN) $(PIP) install -c requirements.lock -r requirements-engines.lock
	@touch $@

table3: install ## the paper's Table 3 into reports/, about three minutes; ARGS=--full takes twenty
	@echo "[3/3] Compiling the paper's steps and those of the default (once), then 32 cells, IDA and Exudyn"
	@$(RUN) -c "from twoloop.kernels.evaluation import inner_loop; from twoloop.kernels import advance, cached_run; \
	from twoloop.kernels.steps import lobatto_step, taylor_step" & \
	$(RUN) -c "from twoloop.kernels.linalg import dependent_columns, rank; \
	from twoloop.kernels.evaluation import checks, sparse_inner_loop; \
	from references.paper import four_bar_minimal; from twoloop.mechanisms import four_bar, planar, quadratic; \
	from twoloop.kernels.paper import fixed_point_step, newmark_step; from twoloop.kernels import interpolation; \
	from twoloop.kernels.steps import explicit_step; from twoloop.kernels.control import stiffness" && wait $$!
	$(RUN) -m studies.table3 $(ARGS)

reports: install ## all studies into reports/
	$(RUN) -m studies all $(ARGS)

# two processes of about equal work, neither of which imports, and so compiles, what the other does: the inner loop and
# the steps of `twoloop` are in one; the other begins with what does without them, and goes on with the paper's steps
compile: install ## compile the kernels, and the callbacks of bodies, mechanisms and studies, on two cores
	@echo "Compiling (once, on both cores) the kernels, and the callbacks of bodies, mechanisms and studies"
	@$(RUN) -c "from twoloop.kernels.evaluation import inner_loop; from twoloop.kernels.control import step_size; \
	from twoloop.kernels.steps import stages; from twoloop.kernels import advance, interpolation; \
	from twoloop.kernels.control import stiffness; from twoloop.kernels.steps import diagonal_step, newton_step; \
	from twoloop.kernels.steps import adams_step, crossing_step, explicit_step, lobatto_step, taylor_step; \
	from twoloop.kernels import cached_run; \
	$(CALLBACKS_OF_TESTS)" & \
	$(RUN) -c "from twoloop.kernels.linalg import dependent_columns, rank; \
	from twoloop.kernels.evaluation import checks, sparse_inner_loop; \
	from twoloop.kernels.lanes import advance, starts; from twoloop.bodies import programs; \
	from twoloop.mechanisms import *; from studies.honesty import traps; from twoloop.kernels.lanes import control; \
	from twoloop.kernels.paper import bdf_step, fixed_point_step, newmark_step; \
	$(CALLBACKS_OF_MORE_TESTS)" && wait $$!

# kernels that slow tests alone need
compile-all: compile
	@echo "Compiling the steps of implicit methods in lanes"
	@$(RUN) -c "from twoloop.kernels.lanes import newton"

# files in the order of tests/conftest.py: sorted by how many tests they have, long ones with few tests would come last
SHARED := -n 2 --dist loadfile --no-loadscope-reorder

# what tests compile when they are imported is compiled before: both workers would do that
test: CALLBACKS_OF_TESTS := import tests.compiled, tests.problems, tests.test_bounds, tests.test_callbacks, \
	tests.test_repeated_calls, tests.test_certificate
test: CALLBACKS_OF_MORE_TESTS := import tests.studies.test_honesty, tests.test_differential, \
	tests.references.test_solver_setups, tests.references.test_equations, tests.references.test_ida, \
	tests.test_derivative_campaign, tests.general.test_consistent_states, tests.general.test_lane_methods, \
	tests.kernels.test_switching, tests.test_traced_values, tests.test_other_parameters
test: compile ## the tests that a change needs, on two cores
	$(RUN) -m pytest $(SHARED) $(ARGS)

test-all: compile-all ## all tests, the slow ones too: about twenty minutes
	@$(MAKE) --no-print-directory test ARGS="-m ''"

# other rounding: no fused operations, and kernels of OpenBLAS for an old processor; a numba cache of its own, as below
test-portable: install ## the tests of twoloop and references as on another processor; ARGS=tests/kernels for some
	@export NUMBA_CPU_NAME=generic OPENBLAS_CORETYPE=Nehalem NUMBA_CACHE_DIR=$(CURDIR)/.venv/portable; \
	$(MAKE) --no-print-directory compile && \
	$(RUN) -m pytest $(SHARED) --ignore tests/studies $(ARGS)

# the numba cache is its own: the versions would take turns in compiling everything anew
test-oldest: .venv-oldest/installed ## the tests of twoloop with the oldest versions it supports; about ten minutes
	NUMBA_CACHE_DIR=$(CURDIR)/.venv-oldest/numba .venv-oldest/bin/python -m pytest tests \
		--ignore tests/references --ignore tests/studies $(ARGS)

.venv-oldest/installed: FITS := import sys, venv, ensurepip; sys.exit(sys.version_info[:2] != (3, 11))
.venv-oldest/installed: NEEDS := 3.11
.venv-oldest/installed: requirements-oldest.txt
	@$(FIND_PYTHON); "$$python" -m venv --clear .venv-oldest
	@.venv-oldest/bin/python $(PIP) install -r requirements-oldest.txt
	@touch $@

lint: install ## ruff and mypy
	$(RUN) -m ruff check .
	$(RUN) -m ruff format --check .
	$(RUN) -m mypy

docs: install ## the documentation, into docs/_build/html; a warning is an error
	$(RUN) -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo "docs/_build/html/index.html"

lock: ## renew the lock files from pyproject.toml; PYTHON=python3.11, the oldest supported
	@$(FIND_PYTHON); "$$python" -m venv --clear .venv
	@$(RUN) $(PIP) install ".[references,symbolic,sweeps,docs,studies,dev]" hatchling
	@{ grep '^#' requirements.lock; $(RUN) -m pip freeze --exclude twoloop; } > requirements.new
	@mv requirements.new requirements.lock
	@$(RUN) $(PIP) install -c requirements.lock ".[peers]"
	@{ grep '^#' requirements-peers.lock; $(RUN) -m pip freeze --exclude twoloop | grep -vxFf requirements.lock; } > requirements.new
	@mv requirements.new requirements-peers.lock
	@$(RUN) $(PIP) install -c requirements.lock -c requirements-peers.lock ".[engines]"
	@{ grep '^#' requirements-engines.lock; $(RUN) -m pip freeze --exclude twoloop | grep -vxFf requirements.lock \
		| grep -vxFf requirements-peers.lock; } > requirements.new
	@mv requirements.new requirements-engines.lock

clean: ## remove caches (numba's too) and builds; .venv and .venv-oldest stay
	find . -name '.venv*' -prune -o -name __pycache__ -type d -prune -exec rm -rf {} +
	rm -rf .pytest_cache .hypothesis .mypy_cache .ruff_cache build dist docs/_build docs/generated
