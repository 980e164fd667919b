#!/usr/bin/env bash
# Check the sdist and the wheel in a folder: their metadata as PyPI does, and that the wheel has the files of the package and
# no others. Example: `tools/check_dist.sh dist`.
# The exit code is 75 if a tool cannot be brought, as the package index does not answer.
set -euo pipefail
root="$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)"

tool() { # tool PACKAGE VERSION ARGUMENTS...: in an environment of its own
    local run=("$root/tools/uv" tool run --quiet "$1@$2")
    if ! "${run[@]}" --version >/dev/null; then
        printf 'check_dist: %s %s could not be brought\n' "$1" "$2" >&2
        exit 75
    fi
    "${run[@]}" "${@:3}"
}

tool twine 7.0.0 check --strict "$1"/*.whl "$1"/*.tar.gz
tool check-wheel-contents 0.6.3 --package "$root/dronevio" --package-omit "ruff.toml,__pycache__,.*_cache" "$1"/*.whl
