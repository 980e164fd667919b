"""How the optional packages of dronevio are installed."""

import json
import shlex
import sys
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

_UV = Path(__file__).resolve().parents[1] / "tools" / "uv"
"""The program that sets a clone up; an installed package has none."""


def install_command(extra: str) -> str:
    """Return the command that installs an extra of this package: in a clone, or from where it was installed from."""
    if _UV.is_file():
        return f"tools/uv sync --inexact --extra {extra}"
    installer = "uv tool install" if (Path(sys.prefix) / "uv-receipt.toml").is_file() else "pip install"
    source = _source()
    return f"{installer} {shlex.quote(f'dronevio[{extra}]' + (f' @ {source}' if source else ''))}"


def _source() -> str:
    """Return the address of the wheel or folder that was installed (PEP 610); empty if it came from an index."""
    try:
        recorded = distribution("dronevio").read_text("direct_url.json")
    except PackageNotFoundError:
        return ""
    return str(json.loads(recorded)["url"]) if recorded else ""
