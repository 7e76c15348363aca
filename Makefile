# Everything runs in a virtual environment of its own, made on first use: make test, make train.
# Another interpreter: make PYTHON=python3.11 test. Arguments: make test ARGS="-k physics", make train ARGS="--seed 1".
PYTHON ?= python3
VENV ?= .venv
ZOO_VENV ?= .venv-zoo
TRANSFER_VENV ?= .venv-transfer
DOCS_VENV ?= .venv-docs
ARGS ?=
MINUTES ?= 10

# Where this is set, every process would compile the sources of PyTorch and its like anew: six seconds each.
unexport PYTHONDONTWRITEBYTECODE

PY := $(VENV)/bin/python
INSTALL := $(PY) -m pip install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt
INSTALLED := $(VENV)/.installed
ZOO_INSTALLED := $(ZOO_VENV)/.installed
TRANSFER_INSTALLED := $(TRANSFER_VENV)/.installed
DOCS_INSTALLED := $(DOCS_VENV)/.installed
LINKS := build/type/sb3_quad

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help install train test test-all test-portable campaign coverage fuzz test-zoo test-transfer transfer-table transfer-files compare-projects docs notebooks docs-links pictures lint format type type-demo links release-check commit-checks clean

help:
	@echo "make install        make $(VENV)/ with the package and its tools; then: . $(VENV)/bin/activate && sb3-quad --help"
	@echo "make train          train with the default settings"
	@echo "make test           run the tests that a change is likely to break, in minutes"
	@echo "make test-all       run these and the slow ones: pages that train, wheels, compilers"
	@echo "make test-portable  run those of make test as an older processor would"
	@echo "make campaign       kill commands at random moments, resume them and compare"
	@echo "make coverage       run those of make test, and show which lines of the packages they do not reach"
	@echo "make fuzz           search with random examples for what the tests do not know yet, for MINUTES=10"
	@echo "make test-zoo       run the tests that need rl_zoo3, Ray or wandb, in an environment of its own"
	@echo "make test-transfer  fly exported agents in the simulators of others, in an environment of its own"
	@echo "make transfer-table print the table of docs/research/export.md, ARGS=\"-n 64 --curves\""
	@echo "make compare-projects  measure them and this package on one core, ARGS=\"--only batch\" some rows"
	@echo "make docs           build the site into build/docs/, in an environment of its own; what is missing or broken is an error"
	@echo "make pictures       draw the pages' pictures anew, ARGS=\"starts.png\" some of them; docs/pictures.py has their commands"
	@echo "make notebooks      run the notebooks whose code has changed, and keep their outputs for the site; ARGS=--rerun all"
	@echo "make docs-links     ask each address outside of the site, where there is a network"
	@echo "make release-check  build, install and try what a release would publish, for each Python at hand"
	@echo "make lint           check code style, and which package imports which"
	@echo "make format         put code into that style"
	@echo "make type           check types of the package, the examples and the tests"
	@echo "make type-demo      check types of the demo's page (npx fetches the compiler)"
	@echo "make commit-checks  format, type and lint"
	@echo "make clean          remove what was built and cached; logs/ and $(VENV)/ stay"

install: $(INSTALLED)

train: $(INSTALLED)
	$(PY) -m sb3_quad.cli train $(ARGS)

# A file's tests share what its fixtures made, so that a file goes to one worker; in the order of their names, since the files with
# the fewest tests, which xdist would leave for the end, take longest.
PYTEST := $(PY) -m pytest -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder --durations=15

test: $(INSTALLED)
	$(PYTEST) -m "not slow" $(ARGS)

test-all: $(INSTALLED)
	$(PYTEST) $(ARGS)

# Weekly in CI. SB3_QUAD_KILLS=50: more of them.
campaign: $(INSTALLED)
	$(PY) -m pytest -m campaign -o timeout=0 $(ARGS)

# Every library takes the code that it has for a processor without AVX, so that sums come out otherwise.
# NumPy refuses names that are no choice here, so that it is asked for those that are.
CHOICES = import numpy._core._multiarray_umath as m; print(*m.__cpu_dispatch__)
test-portable: $(INSTALLED)
	ATEN_CPU_CAPABILITY=default MKL_ENABLE_INSTRUCTIONS=SSE4_2 NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= \
	NUMBA_CACHE_DIR=$(CURDIR)/build/portable \
	NPY_DISABLE_CPU_FEATURES="$$($(PY) -c '$(CHOICES)')" $(PYTEST) -m "not slow" $(ARGS)

# setup.cfg says what is left out: code that numba compiles runs where no tracer sees it.
coverage: $(INSTALLED)
	$(PYTEST) -m "not slow" --cov --cov-report=term:skip-covered --cov-report=html $(ARGS)

# A round is a thousand examples for each property; what fails is kept in .hypothesis/ and tried first from then on.
fuzz: $(INSTALLED)
	@end=$$(($$(date +%s) + 60 * $(MINUTES))); while [ $$(date +%s) -lt $$end ]; do \
		$(PY) -m pytest -m hypothesis --hypothesis-profile fuzz -o timeout=0 $(ARGS) || exit 1; \
	done

test-zoo: $(ZOO_INSTALLED)
	$(ZOO_VENV)/bin/python -m pytest tests/test_zoo.py tests/test_ray.py tests/test_tracking.py $(ARGS)

# Shipped agents as NAME@VEHICLE.onnx; AGENTS="any-quadcopter run/agent.zip" others. ARGS="--curves -n 64": how they follow.
AGENTS ?= any-quadcopter crazyflie-robust itm-robust
OTHERS := examples/other_simulators
TRANSFER_FILES := build/transfer
FLOWN := itm crazyflie hummingbird cf2x_L250 cf21B_500 rotorpy_crazyflie rotorpy_hummingbird l2f_crazyflie
TRANSFER_PY := OMP_NUM_THREADS=1 TRANSFER_FILES=. $(abspath $(TRANSFER_VENV))/bin/python -W ignore

test-transfer: $(TRANSFER_INSTALLED) transfer-files
	cd $(TRANSFER_FILES) && $(TRANSFER_PY) -m pytest -q -c /dev/null --rootdir $(abspath $(OTHERS)) $(abspath $(OTHERS)) $(ARGS)

transfer-table: $(TRANSFER_INSTALLED) transfer-files
	@cd $(TRANSFER_FILES) && for where in crazyflow,"--delay 0 1" rotorpy, l2f,; do \
		echo; echo "In $${where%%,*}:"; echo; \
		$(TRANSFER_PY) $(abspath $(OTHERS))/in_$${where%%,*}.py *.onnx $${where#*,} $(ARGS); \
	done; echo; echo "In sb3_quad:"; echo; \
	PYTHONPATH=$(CURDIR):$$($(abspath $(PY)) -c 'import sysconfig; print(sysconfig.get_path("purelib"))') \
	$(TRANSFER_PY) $(abspath $(OTHERS))/in_own.py *.onnx --delay 0 1 $(ARGS)

compare-projects: $(INSTALLED) $(TRANSFER_INSTALLED)
	OMP_NUM_THREADS=1 PYTHONPATH=$(OTHERS) $(PY) -W ignore examples/compare_projects.py --others $(TRANSFER_VENV)/bin/python $(ARGS)

# A crazyflie-robust flies the crazyflies only, itm-robust itm.
transfer-files: $(INSTALLED)
	@rm -rf $(TRANSFER_FILES) && mkdir -p $(TRANSFER_FILES)
	@for agent in $(AGENTS); do name=$$(basename $$agent .zip); for vehicle in $(FLOWN); do \
		case $$name@$$vehicle in itm-*@itm) ;; itm-*|crazyflie-*@itm|crazyflie-*@*hummingbird) continue;; esac; \
		$(PY) -m sb3_quad.cli export $$agent --format onnx --vehicle $$vehicle -o $(TRANSFER_FILES)/$$name@$$vehicle.onnx >/dev/null || exit 1; \
	done; done

# -n: what a page or a docstring refers to must be there.
SPHINX := $(DOCS_VENV)/bin/python -m sphinx -E -n -W --keep-going -q -d build/doctrees

docs: $(DOCS_INSTALLED)
	$(SPHINX) -b html docs build/docs $(ARGS)
	@echo "build/docs/index.html"

notebooks: $(INSTALLED)
	MPLBACKEND=Agg $(PY) docs/notebook_pages.py $(ARGS)

docs-links: $(DOCS_INSTALLED)
	$(SPHINX) -b linkcheck docs build/links $(ARGS)

# Films come with the extra [video], which dev has.
pictures: $(INSTALLED)
	$(PY) docs/pictures.py $(ARGS)

release-check:
	.ci/release_check

lint: $(INSTALLED) links
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	cd build/type && $(abspath $(VENV))/bin/lint-imports --no-cache --config ../../setup.cfg

format: $(INSTALLED)
	$(PY) -m ruff check --fix --exit-zero --quiet .
	$(PY) -m ruff format .

# Tests hand over wrong types on purpose, replace methods, and know which member of a union they get.
# What is left holds names, attributes, imports and the arguments of calls.
LOOSE := $(addprefix --disable-error-code=,arg-type assignment call-overload dict-item func-returns-value has-type \
	index list-item method-assign misc operator override type-var union-attr unreachable unused-ignore var-annotated)

type: $(INSTALLED) links
	$(PY) -m mypy
	$(PY) -m mypy --config-file tests/mypy.ini examples
	$(PY) -m mypy --config-file tests/mypy.ini $(LOOSE) tests

# The page's scripts are JavaScript with types in comments.
type-demo:
	npx --yes --package typescript@5 tsc -p sb3_quad/show/demo/jsconfig.json

# mypy and import-linter do not follow package_dir, by which a checkout's envs/ and its like are part of sb3_quad: links do.
links:
	@rm -rf $(LINKS) && mkdir -p $(LINKS)
	@for path in sb3_quad/* envs callbacks zoo_configs; do ln -s "$(CURDIR)/$$path" $(LINKS); done

commit-checks: format type lint

clean:
	rm -rf build dist *.egg-info .coverage .coverage.* .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find sb3_quad envs callbacks zoo_configs tests -name __pycache__ -prune -exec rm -rf {} +

$(PY):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || { \
		echo "Python 3.10 or later is needed, and $(PYTHON) is none; name one: make PYTHON=python3.11 ..." >&2; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' || { \
		echo "$(PYTHON) cannot make virtual environments; its venv package is missing (Debian: python3-venv)" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

# What comes without a wheel is built by setuptools, as this package is.
# An environment that another checkout has installed itself into is used as it is: it would point here from then on.
$(INSTALLED): setup.cfg pyproject.toml constraints.txt | $(PY)
	@owner=$$(cat $@ 2>/dev/null || true); \
	if [ -e "$$owner/setup.cfg" ] && ! [ "$$owner" -ef . ]; then \
		echo "$(VENV) is that of $$owner, and is used as it is"; \
	else \
		echo "Installing into $(VENV), pinned by constraints.txt; some minutes the first time ..."; \
		$(INSTALL) setuptools && $(INSTALL) --no-build-isolation --editable '.[dev]' && echo "$(CURDIR)" >$@; \
	fi

# Simulators of others, without this package: they fly its exported files.
$(TRANSFER_INSTALLED): examples/other_simulators/requirements.txt
	$(PYTHON) -m venv $(TRANSFER_VENV)
	@$(TRANSFER_VENV)/bin/python -m pip install --quiet --no-compile --disable-pip-version-check --requirement $<
	@touch $@

# Environments that borrow all packages of the first: Ray, rl_zoo3 and wandb; Sphinx.
BORROW = $(PY) -m venv --without-pip $(1) && $(PY) -c 'import sysconfig as s; print("import site; site.addsitedir(%r)" % s.get_path("purelib"))' > \
	"$$($(1)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/borrowed.pth" && \
	$(PY) -m pip --python $(1) install --quiet --no-compile --disable-pip-version-check --constraint constraints.txt

$(ZOO_INSTALLED): constraints.txt $(INSTALLED)
	@$(call BORROW,$(ZOO_VENV)) 'rl_zoo3[plots]' requests 'ray[tune]' wandb
	@touch $@

# What the extra `docs` of setup.cfg lists.
DOCS_PACKAGES := $(shell sed -n '/^docs =$$/,/^[a-z]* =$$/s/^    //p' setup.cfg)

$(DOCS_INSTALLED): constraints.txt setup.cfg $(INSTALLED)
	@$(call BORROW,$(DOCS_VENV)) $(DOCS_PACKAGES)
	@touch $@
