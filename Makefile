# Everything happens in this folder: uv and the packages are brought into .uv/ and .venv/ when they are first needed.

.PHONY: help setup run test check

help:
	@echo "make run [ARGS='--seed 3']   fly, estimate, score and report"
	@echo "make test [ARGS='-k imu']    run the tests"
	@echo "make check                   lint, types and import contracts"
	@echo "make setup                   only set up; the others do it too"

setup:
	@scripts/setup.sh

run: setup
	@.venv/bin/dronevio run $(ARGS)

test: setup
	.venv/bin/pytest $(ARGS)

check: setup
	.venv/bin/ruff check
	.venv/bin/ruff format --check
	.venv/bin/mypy
	.venv/bin/lint-imports
