# make train: set up, train, evaluate, leave a film in runs/      make test: set up, lint, type check, test
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
ENV ?= ClothDrape-v0
SEED ?= 0

.PHONY: train test bench clean

train: $(VENV)/ready
	$(BIN)/python training/train.py --env $(ENV) --seed $(SEED) $(ARGS)

test: $(VENV)/ready
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pytest -q -n 2

bench: $(VENV)/ready
	$(BIN)/python -m clothgym bench

# the link lets editors and type checkers find clothgym.envs, which lives in envs/
$(VENV)/ready: pyproject.toml .ci/constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --constraint .ci/constraints.txt "torch==2.13.0"
	$(BIN)/pip install --quiet --constraint .ci/constraints.txt --editable ".[all,dev]"
	ln -sfn ../envs clothgym/envs
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info clothgym/envs
