# Everything runs inside .venv, which the first target that needs it creates.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
DEMO_SOURCE ?= procedural:midtown?blocks=2x2&seed=1
DEMO_DATA ?= demo_city
PORT ?= 8000
# A file of tests is one process's: its datasets are baked once. More than four processes would bake more of what several files share.
PYTEST := $(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

.PHONY: help demo test test-all check lint-docker bench format clean
.DEFAULT_GOAL := help

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "  make %-11s %s\n", $$1, $$2}'

$(VENV)/.ready: pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	@touch $@

$(VENV)/.judge: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev,docker,judge,sky]'
	@touch $@

$(VENV)/.docker: $(VENV)/.ready
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev,docker]'
	@touch $@

demo: $(VENV)/.ready ## bake a small procedural city and serve it, with somebody walking (Ctrl-C stops the server)
	$(BIN)/sectorlight bake '$(DEMO_SOURCE)' -o $(DEMO_DATA)
	@echo '[{"id": "walker"}]' > $(DEMO_DATA)_players.json
	@echo "Open http://127.0.0.1:$(PORT)/ in a browser"
	$(BIN)/sectorlight serve $(DEMO_DATA) --port $(PORT) --players $(DEMO_DATA)_players.json

test: $(VENV)/.ready ## the tests, without the slow ones
	$(PYTEST)

test-all: $(VENV)/.judge ## every test: slow, statistical, against Mitsuba and Radiance, and linters of docker/
	$(PYTEST) -m ''

check: $(VENV)/.ready ## the gate: format, lint, types, tests
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(PYTEST)

lint-docker: $(VENV)/.docker ## lint docker/Dockerfile and docker/compose.yaml
	$(BIN)/hadolint docker/Dockerfile
	$(BIN)/compose-lint docker/compose.yaml

bench: $(VENV)/.ready ## timings, each beside its baseline
	$(BIN)/sectorlight bench

format: $(VENV)/.ready ## rewrite the code in the project's format
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

clean: ## remove the virtual environment and the demo's data
	rm -rf $(VENV) $(DEMO_DATA) $(DEMO_DATA)_players.json
