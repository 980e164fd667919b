#!/usr/bin/env bash
# Build the documentation site in build/site, or serve it: tools/docs.sh build|serve [OPTIONS OF MKDOCS].
# The reference pages and those of the environments are made from the code first, and the lessons are executed, unless
# build/lessons has them. Nothing is fetched but locked packages.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
unset VIRTUAL_ENV UV_PROJECT_ENVIRONMENT # another environment may be active: ours is .venv
export NO_MKDOCS_2_WARNING=1             # Material's advertisement of its successor

tools/uv sync --locked --quiet --inexact --group docs </dev/null
.venv/bin/python tools/cli_reference.py docs/reference/cli
.venv/bin/python tools/api_reference.py docs/reference/api
.venv/bin/python tools/environment_pages.py docs/environments
.venv/bin/python tools/lessons.py --pages docs/lessons
.venv/bin/python -m mkdocs "$@"

if [ "$1" = build ] && grep -rlE '<(script|img|link)[^>]* (src|href)="(https?:)?//' build/site --include='*.html'; then
    echo "docs: these pages load something from elsewhere; a page has to be complete in the site" >&2
    exit 1
fi
