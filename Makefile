# Everything runs in .venv, which is created on first use and updated when its requirements change.

PYTHON ?= python3
TORCH ?= 2.13.0
TESTS ?= tests
JOBS ?= auto
COMPILE :=

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install -q --disable-pip-version-check

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help run compile test test-slow test-learning check check-audit check-docs check-install check-lowest clients check-clients check-pages check-paper check-faults check-fuzz check-endurance check-mutants check-stress browser check-live docs format board speed speed-docs constraints clean

help: ## List the targets
	@sed -n 's/^\([a-z-]*\):.*## \(.*\)/make \1|\2/p' $(MAKEFILE_LIST) | \
	while IFS='|' read -r target text; do printf '%-20s %s\n' "  $$target" "$$text"; done

run: compile ## Compare three controllers, with and without slip: a table, and a picture in results/demo
	$(BIN)/tlf demo

compile: $(VENV)/.stamp-run ## Compile the step drivers, if that was not done before
	$(BIN)/tlf compile $(COMPILE)

# Compiled first, because every process of pytest would compile the same drivers otherwise.
# In the order of their names: the files with the fewest tests, which would come last otherwise, take longest.
test: $(VENV)/.stamp-test ## Run the checks, and compile meanwhile; then run the tests
	$(MAKE) -j 2 check compile COMPILE=--all
	$(BIN)/pytest -n $(JOBS) --dist loadfile --no-loadscope-reorder --durations=25 --durations-min=5

test-slow: $(VENV)/.stamp-test ## Run the slow tests
	$(BIN)/pytest -m slow

test-learning: $(VENV)/.stamp-train ## Run the tests that need stable-baselines3 and torch
	$(BIN)/pytest tests/test_sb3.py tests/test_learned.py tests/test_learners.py tests/test_doors.py tests/test_train.py \
		tests/test_examples.py tests/test_gymnasium.py tests/test_checkpoints.py tests/test_history.py tests/test_export.py \
		tests/test_train_search.py tests/test_sensor_policies.py tests/test_offline.py tests/test_algorithms.py \
		tests/test_differentiable.py tests/test_neighbours.py tests/test_trust.py

check: $(VENV)/.stamp-test ## Lint, check format and types
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache
	$(BIN)/codespell

# pip cannot choose the lowest versions, uv can; but it does not read pip's setting of folders of wheels.
# torch comes first, so that a build of the fixed version in such a folder is taken.
check-pages: $(VENV)/.stamp-test browser ## Test the pages of HTML in a headless Chromium
	$(BIN)/python -m pip install -q --disable-pip-version-check -c constraints.txt -e ".[browser]"
	TLF_BROWSER=needed $(BIN)/pytest tests/browser

check-paper: $(VENV)/.stamp-test ## Compute all figures and claims of the paper anew, and compare them with docs/paper.md
	$(BIN)/pytest -m "slow or not slow" tests/test_paper.py

browser: ## Install Chromium and its driver, if there are none (Debian's packages, as root)
	@(command -v chromium || command -v google-chrome) >/dev/null && command -v chromedriver >/dev/null || \
		{ apt-get update -q && apt-get install -y -q chromium chromium-driver; }

check-lowest: ## Run the tests with the lowest versions that pyproject.toml allows, in a temporary environment
	@set -e; \
	tmp=$$(mktemp -d); trap 'rm -rf "$$tmp"' EXIT; \
	$(PYTHON) -m venv "$$tmp/tools"; \
	"$$tmp/tools/bin/python" -m pip install -q --disable-pip-version-check uv; \
	uv="$$tmp/tools/bin/uv"; \
	export UV_FIND_LINKS="$${PIP_FIND_LINKS-}" VIRTUAL_ENV="$$tmp/venv"; \
	"$$uv" venv -q --python "$(PYTHON)" "$$VIRTUAL_ENV"; \
	"$$uv" pip install -q "torch==$(TORCH)"; \
	"$$uv" pip install -q --resolution lowest-direct \
		-e ".[bench,benchmarl,data,dev,figures,mpc,peers,ray,train,tune,view]"; \
	"$$uv" pip check; \
	"$$VIRTUAL_ENV/bin/python" -m pytest $(TESTS)

# EXTRAS: all-train tries a training, too.
EXTRAS ?= bench,data,figures
check-install: ## Build sdist and wheel, and play the first hour in a clean environment outside the checkout
	@set -e; \
	tmp=$$(mktemp -d); trap 'rm -rf "$$tmp"' EXIT; \
	$(PYTHON) -m venv "$$tmp/tools"; \
	"$$tmp/tools/bin/python" -m pip install -q --disable-pip-version-check build twine; \
	"$$tmp/tools/bin/python" -m build --outdir "$$tmp/dist" .; \
	"$$tmp/tools/bin/python" -m twine check --strict "$$tmp"/dist/*; \
	$(PYTHON) -m venv "$$tmp/venv"; \
	"$$tmp/venv/bin/python" -m pip install -q --disable-pip-version-check -c constraints.txt \
		"$$(ls "$$tmp"/dist/*.whl)[$(EXTRAS)]"; \
	mkdir "$$tmp/elsewhere"; cd "$$tmp/elsewhere"; \
	PATH="$$tmp/venv/bin:$$PATH" sh "$(CURDIR)/tests/first_hour.sh"

# Their requirements exclude each other. The trainings' numbers go to results/clients; `python docs/figures/make_clients.py`
# makes the page's tables of them. RESUME=--resume keeps the trainings that are finished. LOWEST=--lowest takes the lowest
# versions that pyproject.toml allows.
clients: ## Test and train with other libraries, or some of them (CLIENTS="sb3 ray"), each in a temporary environment
	$(PYTHON) tests/clients/each.py --torch $(TORCH) $(RESUME) $(LOWEST) $(CLIENTS)

check-clients: clients # the earlier name

# A tool of development (codespell) may have any licence: nothing of it is used by the package.
REFUSED_LICENCES := GPL-2.0-only;GPL-2.0-or-later;GPL-3.0-only;GPL-3.0-or-later;GNU General Public License v2 (GPLv2);GNU General Public License v3 (GPLv3);GNU Affero General Public License v3
check-audit: $(VENV)/.stamp-test ## List the licences of all requirements, and look for known vulnerabilities (needs pypi.org)
	@set -e; \
	tmp=$$(mktemp -d); trap 'rm -rf "$$tmp"' EXIT; \
	$(PYTHON) -m venv "$$tmp"; \
	"$$tmp/bin/python" -m pip install -q --disable-pip-version-check pip-audit pip-licenses; \
	"$$tmp/bin/pip-licenses" --python=$(BIN)/python --format=markdown --ignore-packages codespell \
		--fail-on "$(REFUSED_LICENCES)"; \
	"$$tmp/bin/pip-audit" --strict --no-deps --disable-pip -r constraints.txt

# The campaign of docs/reliability.md. Each writes into results/campaign what it has tried; most go on where they stopped.
CASES ?= 600
check-fuzz: $(VENV)/.stamp-test ## Try files, actions, snapshots and arguments that are wrong (an hour)
	$(BIN)/python tests/campaign/fuzz.py --cases $(CASES)

SUBSTEPS ?= 1e8
check-stress: $(VENV)/.stamp-test ## Audit work, momentum and friction in every substep of random robots (an hour)
	$(BIN)/python tests/campaign/stress.py batch --substeps $(SUBSTEPS)
	$(BIN)/python tests/campaign/stress.py presets --cases 66
	$(BIN)/python tests/campaign/stress.py chipmunk --substeps 1e6
	$(BIN)/python tests/campaign/stress.py contact --substeps 1e6
	$(BIN)/python tests/campaign/stress.py agree --cases 100

check-faults: $(VENV)/.stamp-train ## Kill and stop the long commands, and take their disk away (as root, an hour)
	$(BIN)/python tests/campaign/kills.py --kills 50
	$(BIN)/python tests/campaign/stops.py --learning
	$(BIN)/python tests/campaign/disks.py
	$(BIN)/python tests/campaign/compiling.py

check-endurance: $(VENV)/.stamp-test ## Ten million steps, a thousand environments, wrong clocks (needs faketime)
	for what in steps many starts clock; do $(BIN)/python tests/campaign/endurance.py $$what || exit 1; done

check-mutants: $(VENV)/.stamp-test ## Change the laws at random, and count the changes that the tests notice (an hour)
	$(BIN)/python tests/campaign/mutants.py --sample 300 --seed 1

# The live windows under real keys and a real mouse; their pictures stay in results/live.
check-live: $(VENV)/.stamp-test ## Drive the live windows on a virtual display (needs Xvfb and xdotool)
	$(BIN)/python tests/live_window.py

# Warnings are errors: a link to a page or heading that is not there, a docstring that cannot be read.
docs: $(VENV)/.stamp-docs ## Build the documentation site into site/; open site/index.html
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet

# NOTEBOOKS: names without .ipynb; all by default. What needs BenchMARL is skipped: its requirements exclude others.
NOTEBOOKS ?=
check-docs: docs $(VENV)/.stamp-train ## Build the site, check its links, and execute the notebooks
	$(BIN)/python docs/generate/check_links.py site
	$(BIN)/python docs/generate/notebook_pages.py --check $(NOTEBOOKS)

format: $(VENV)/.stamp-test ## Sort the imports and format the sources
	$(BIN)/ruff check --select I --fix
	$(BIN)/ruff format

speed: $(VENV)/.stamp-test ## Measure steps per second, compared with other environments
	$(BIN)/tlf speed

speed-docs: $(VENV)/.stamp-test ## Measure steps per second and update docs/performance.md and its figure
	$(BIN)/tlf speed --memory --cold --out docs/performance.json >/dev/null
	$(BIN)/python docs/figures/make_speed.py

board: $(VENV)/.stamp-test ## Run the plan of the published leaderboard (hours, resumable) and write its pages
	$(BIN)/tlf bench --plan board --out results/board
	$(BIN)/python docs/figures/make_board.py results/board

# The version of torch is fixed (make constraints TORCH=...); all others are resolved again.
# Requirements of torch that exist on one kind of machine only are left out.
constraints: ## Update constraints.txt from a temporary environment with every extra
	@set -e; \
	tmp=$$(mktemp -d); trap 'rm -rf "$$tmp"' EXIT; \
	$(PYTHON) -m venv "$$tmp/venv"; \
	py="$$tmp/venv/bin/python"; \
	"$$py" -m pip install -q --disable-pip-version-check "torch==$(TORCH)" \
		build editables hatchling ".[bench,benchmarl,data,dev,docs,figures,mpc,peers,peers-jax,ray,train,tune,view]"; \
	"$$py" -m pip check; \
	echo "# Versions of everything that the extras install. Made by: make constraints" > "$$tmp/new"; \
	"$$py" -m pip freeze --all --exclude pip --exclude tlf-env > "$$tmp/frozen"; \
	sed -e '/^\(cuda-\|nvidia-\|triton\)/d' -e 's/+[A-Za-z0-9.]*$$//' "$$tmp/frozen" >> "$$tmp/new"; \
	cp "$$tmp/new" constraints.txt

clean: ## Remove .venv, caches and built packages (results are kept)
	rm -rf $(VENV) .hypothesis .mypy_cache .pytest_cache .ruff_cache build dist site
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(VENV)/.stamp-venv:
	@$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("Python 3.11 or newer is needed")'
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.stamp-run: $(VENV)/.stamp-venv pyproject.toml constraints.txt
	$(PIP) -c constraints.txt -e ".[figures]"
	@touch $@

# mpe2 instead of the extra `peers`, because that also installs vmas and with it torch.
$(VENV)/.stamp-test: $(VENV)/.stamp-run
	$(PIP) -c constraints.txt -e ".[bench,data,figures,mpc,tune,view,dev]" mpe2
	@touch $@

$(VENV)/.stamp-docs: $(VENV)/.stamp-test
	$(PIP) -c constraints.txt -e ".[docs]"
	@touch $@

$(VENV)/.stamp-train: $(VENV)/.stamp-test
	$(PIP) -c constraints.txt -e ".[train]"
	@touch $@
