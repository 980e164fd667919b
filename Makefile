# Everything happens in this folder: uv and the packages are brought into .uv/ and .venv/ when they are first needed.

.PHONY: help setup run test check lint format types contracts docs docs-serve lesson lessons pictures seeds

help:
	@echo "make run [ARGS='--seed 3']   fly, estimate, score and report"
	@echo "make test [ARGS='-k imu']    run the tests"
	@echo "make check                   lint, format, types and import contracts"
	@echo "make docs                    build the documentation site in build/site"
	@echo "make docs-serve              show it on 127.0.0.1:8000 while pages are edited"
	@echo "make lesson NAME=imu         open a lesson in JupyterLab, in this folder"
	@echo "make lessons                 execute the lessons of dronevio book open, and the changes that break them"
	@echo "make pictures                make the table of ten seeds and the pictures anew, from the same runs"
	@echo "make seeds                   fly seeds 0 to 9 and print their table"
	@echo "make setup                   only set up; the others do it too"

setup:
	@tools/setup.sh

run: setup
	@.venv/bin/dronevio run $(ARGS)

test: setup
	.venv/bin/pytest $(ARGS)

check: lint format types contracts

lint: setup
	.venv/bin/ruff check

format: setup
	.venv/bin/ruff format --check

types: setup
	.venv/bin/mypy
	.venv/bin/mypy --explicit-package-bases benchmarks tools tests

contracts: setup
	.venv/bin/lint-imports

docs: setup
	@tools/docs.sh build --strict

docs-serve: setup
	@tools/docs.sh serve --dev-addr 127.0.0.1:8000

lesson: setup
	@tools/uv sync --locked --quiet --inexact --extra book </dev/null
	@.venv/bin/dronevio book open $(NAME) $(if $(NAME),--lab)

lessons: setup
	@tools/uv sync --locked --quiet --inexact --group lessons </dev/null
	.venv/bin/python tools/lessons.py $(ARGS)

pictures: setup
	rm -rf build/pictures
	.venv/bin/python tools/seeds.py --write --keep build/pictures
	.venv/bin/python tools/dense_picture.py
	.venv/bin/python tools/map_picture.py
	.venv/bin/python tools/explore_picture.py
	.venv/bin/python tools/explore_failures.py
	.venv/bin/python tools/environment_pictures.py
	.venv/bin/python tools/pictures.py --run build/pictures/0

seeds: setup
	@.venv/bin/python tools/seeds.py $(ARGS)
