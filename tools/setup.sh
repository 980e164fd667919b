#!/usr/bin/env bash
# Set up everything that the command and the tests need, in this folder: .venv/ with the locked packages, and a look at
# whether OpenGL renders off-screen. Quick when there is nothing to do.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

stamp=".venv/.set-up"
packages=(libegl1 libgl1-mesa-dri libopengl0) # off-screen OpenGL on Debian and Ubuntu, with no graphics card needed
unset VIRTUAL_ENV UV_PROJECT_ENVIRONMENT # another environment may be active: ours is .venv

say() { printf 'setup: %s\n' "$*" >&2; }

inputs() { # what the set-up depends on: where it is, and the files that define it
    pwd
    cksum uv.lock pyproject.toml tools/setup.sh
}

opengl_renders() { .venv/bin/dronevio doctor >/dev/null 2>&1; }

install_opengl() { # with apt, where it may be used without asking anybody
    local as_root=()
    command -v apt-get >/dev/null || return 1
    if [ "$(id -u)" -ne 0 ]; then
        sudo -n true 2>/dev/null || return 1
        as_root=(sudo -n)
    fi
    say "no off-screen OpenGL: installing ${packages[*]} with apt"
    ${as_root[@]+"${as_root[@]}"} apt-get update -qq </dev/null >&2 &&
        ${as_root[@]+"${as_root[@]}"} env DEBIAN_FRONTEND=noninteractive \
            apt-get install -qq -y --no-install-recommends "${packages[@]}" </dev/null >/dev/null
}

if [ -f "$stamp" ]; then
    if [ "$(cat "$stamp")" = "$(inputs)" ]; then exit 0; fi
    # Scripts in .venv/bin name the folder that they were made in.
    if [ "$(head -n 1 "$stamp")" != "$(pwd)" ]; then rm -rf .venv; fi
fi

say "bringing the locked packages into .venv/"
tools/uv sync --locked --quiet </dev/null

if ! opengl_renders; then
    install_opengl || true
    if ! opengl_renders; then
        .venv/bin/dronevio doctor >&2 || exit 2 # its last line is the command to type
    fi
fi

inputs >"$stamp"
