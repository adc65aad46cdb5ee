# The tasks of development; .ci/run calls the same. PYTHON is an environment with the extras [dev,docs]
PYTHON ?= .venv/bin/python
RUFF ?= $(PYTHON) -m ruff

.PHONY: install lint types test slow docs check

install:
	python3 -m venv .venv
	.venv/bin/pip install -c constraints.txt -e ".[dev,docs]"

lint:
	$(RUFF) check .
	$(RUFF) format --check .

types:
	$(PYTHON) -m mypy
	$(dir $(PYTHON))lint-imports

test:
	$(PYTHON) -m pytest -q

slow:
	$(PYTHON) -m pytest -q -m ""

docs:
	$(PYTHON) -m mkdocs build --strict  # with --quiet, nothing would be strict

check: lint types test docs
