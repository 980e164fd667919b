"""How the optional packages of dronevio are installed."""

from pathlib import Path

_UV = Path(__file__).resolve().parents[1] / "tools" / "uv"
"""The program that sets a clone up; an installed package has none."""


def install_command(extra: str) -> str:
    """Return the command that installs an extra of this package: in the environment of a clone, or by pip."""
    if _UV.is_file():
        return f"tools/uv sync --inexact --extra {extra}"
    return f"pip install 'dronevio[{extra}]'"
