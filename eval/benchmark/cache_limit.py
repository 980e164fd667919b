"""Folder and largest size of the cache of recordings on this machine."""

import math
import os
import shutil
from pathlib import Path

from dronevio.models.errors import ConfigError

LIMIT_VARIABLE = "DRONEVIO_RECORDINGS_GB"
"""Environment variable with the largest size of the cache of recordings [GB]; ``inf`` for no limit."""
_DEFAULT_BYTES = 50e9
_DEFAULT_SHARE = 0.5  # of the space that is free or taken by the cache


def default_folder() -> Path:
    """Return the folder of cached recordings: in ``$XDG_CACHE_HOME``, by default in ``~/.cache``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "dronevio" / "recordings"


def limit_bytes(folder: Path, used_bytes: float) -> float:
    """Return the largest size of a cache: that of the environment variable, or 50 GB, at most half of the free disk.

    Args:
        folder: Folder of the cache; it may be missing.
        used_bytes: Size of the recordings in it, which counts as free.

    Raises:
        ConfigError: The environment variable is not a size.
    """
    given = os.environ.get(LIMIT_VARIABLE)
    if not given:
        existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
        return min(_DEFAULT_BYTES, _DEFAULT_SHARE * (shutil.disk_usage(existing).free + used_bytes))
    try:
        limit_gb = float(given)
    except ValueError:
        limit_gb = math.nan
    if not limit_gb >= 0.0:
        raise ConfigError(f"{LIMIT_VARIABLE}={given}; expected a size in GB, such as 50, or inf")
    return limit_gb * 1e9


def size_bytes(folder: Path) -> int:
    """Return the size of all files in a folder; 0 if it is missing. Files that vanish meanwhile count as nothing."""
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            try:
                total += Path(place, name).lstat().st_size
            except OSError:
                continue
    return total
