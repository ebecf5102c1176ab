# make train: set up, train, evaluate, leave a film in runs/      make test: set up, lint, type check, test
# make test-all: also the slow tests, which train, record and export
# make check: lint, type check, and tests of each floor that are quick once their kernels are compiled
# make bits: digests of every id, method and contact, compiled for this processor and for two other instruction sets of x86-64
# make clients: tests with other libraries      make rllib: with Ray, and the older Gymnasium that it pins
# make lerobot: with LeRobot, in Python 3.12 or later, LEROBOT_PYTHON
# make oldest: tests with the oldest dependencies; each of these in an environment of its own
# make release: wheel and sdist of what is committed, checked and tried out      make notebook: runs docs/notebooks/
# make site: the documentation as a site in build/site, from the pages, the docstrings and the command line's help
PYTHON ?= python3
PYTHONS ?= $(PYTHON)
LEROBOT_PYTHON ?= python3.12
VENV ?= .venv
BIN = $(VENV)/bin
ENV ?= ClothDrape-v0
SEED ?= 0
QUICK = floors closest intersections mesh grid_forces integrators collisions self_contact guards simulation shading reach bits_command
OLDEST = closest intersections mesh integrators simulation envs reach

.PHONY: train check lint test test-all bits clients rllib lerobot oldest notebook release site bench clean

train: $(VENV)/ready
	$(BIN)/python training/train.py --env $(ENV) --seed $(SEED) $(ARGS)

lint: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

check: lint
	$(BIN)/python -m pytest -q -n 2 --dist worksteal $(QUICK:%=tests/test_%.py)
	$(BIN)/python -m pytest -q -k "refused or wrong" tests/test_cli.py tests/test_training.py

test: lint
	$(BIN)/python -m pytest -q -n 2 --dist worksteal --durations=10 -m "not slow"

test-all: lint
	$(BIN)/python -m pytest -q -n 2 --dist worksteal --durations=10

bits: $(VENV)/ready
	$(BIN)/python benchmarks/bits.py --json $(VENV)/bits.json
	NUMBA_CPU_NAME=generic $(BIN)/python benchmarks/bits.py --compare $(VENV)/bits.json
	NUMBA_CPU_NAME=haswell $(BIN)/python benchmarks/bits.py --compare $(VENV)/bits.json

clients:
	$(PYTHON) -m venv $(VENV)-clients
	$(VENV)-clients/bin/pip install --quiet --constraint .ci/clients.txt "torch==2.13.0" "pytest>=8" ".[clients]"
	cd tests && ../$(VENV)-clients/bin/python -m pytest -q clients

rllib:
	$(PYTHON) -m venv $(VENV)-rllib
	$(VENV)-rllib/bin/pip install --quiet --constraint .ci/rllib.txt "torch==2.13.0" "pytest>=8" ".[rllib]"
	cd tests && ../$(VENV)-rllib/bin/python -m pytest -q rllib test_reach.py test_vector_env.py

lerobot:
	$(LEROBOT_PYTHON) -m venv $(VENV)-lerobot
	$(VENV)-lerobot/bin/pip install --quiet --no-deps "lerobot==0.6.1"
	$(VENV)-lerobot/bin/pip install --quiet --constraint .ci/lerobot.txt "torch==2.13.0" $$(sed '/^#/d; s/=.*//' .ci/lerobot.txt) "pytest>=8" ".[record]"
	cd tests && ../$(VENV)-lerobot/bin/python -m pytest -q with_lerobot

oldest:
	$(PYTHON) -m venv $(VENV)-oldest
	$(VENV)-oldest/bin/pip install --quiet --constraint .ci/oldest.txt "pytest>=8" .
	cd tests && ../$(VENV)-oldest/bin/python -m pytest -q $(OLDEST:%=test_%.py)

notebook:
	$(PYTHON) -m venv $(VENV)-notebook
	$(VENV)-notebook/bin/pip install --quiet --constraint .ci/constraints.txt --constraint .ci/notebook.txt "torch==2.13.0" "pytest>=8" ".[notebook]"
	cd tests && ../$(VENV)-notebook/bin/python -m pytest -q notebooks

release:
	.ci/release $(PYTHONS)

site:
	$(PYTHON) -m venv $(VENV)-site
	$(VENV)-site/bin/pip install --quiet --constraint .ci/docs.txt ".[docs]"
	rm -rf build/site
	$(VENV)-site/bin/sphinx-build -q -W --keep-going docs build/site
	$(VENV)-site/bin/python docs/check_site.py build/site

bench: $(VENV)/ready
	$(BIN)/python -m clothgym bench

# the link lets editors and type checkers find clothgym.envs, which lives in envs/
$(VENV)/ready: pyproject.toml .ci/constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --constraint .ci/constraints.txt "torch==2.13.0"
	$(BIN)/pip install --quiet --constraint .ci/constraints.txt --editable ".[all,tune,dev]"
	ln -sfn ../envs clothgym/envs
	touch $@

clean:
	rm -rf $(VENV) $(VENV)-clients $(VENV)-rllib $(VENV)-lerobot $(VENV)-oldest $(VENV)-notebook $(VENV)-site build dist *.egg-info clothgym/envs
