#!/usr/bin/env bash
# Test the built package: the wheel that is made from the sdist, in an environment of its own, with nothing of the
# checkout. It flies with its own dependencies alone, then runs the tests. Arguments go to pytest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
unset VIRTUAL_ENV UV_PROJECT_ENVIRONMENT

scratch="$PWD/build/wheel-test"
rm -rf "$scratch" && mkdir -p "$scratch/home"
trap 'rm -rf "$scratch"' EXIT

tools/uv build --quiet --out-dir "$scratch/dist"
tools/check_dist.sh "$scratch/dist" || [ $? -eq 75 ] # no tools: the package index does not answer

install() { tools/uv pip install --quiet --python "$scratch/venv/bin/python" "$@"; }
tools/uv export --quiet --locked --no-emit-project --no-hashes --output-file "$scratch/locked.txt"
tools/uv venv --quiet --python .venv/bin/python "$scratch/venv"
install --constraint "$scratch/locked.txt" "$scratch"/dist/dronevio-*.whl
(
    cd "$scratch/home"
    env -i HOME="$PWD" PATH=/usr/bin:/bin "$scratch/venv/bin/dronevio" run --scenario short --out flight
    test -s flight/report.html
)
install --requirement "$scratch/locked.txt"

cp -r tests README.md pyproject.toml "$scratch/"
cd "$scratch"
venv/bin/python - <<'END'
from pathlib import Path

import dronevio

home = Path(dronevio.__file__).parent
assert home.parent.name == "site-packages", f"tested {home}, not the wheel"
links = [str(path) for path in home.rglob("*") if path.is_symlink()]
assert not links, f"the wheel has links instead of files: {links}"
END
venv/bin/pytest "$@"
