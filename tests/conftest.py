import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Folder of public data sets that the project does not carry; tests that need it are skipped where it is not."""
    folder = os.environ.get("DRONEVIO_DATA")
    if not folder:
        pytest.skip("DRONEVIO_DATA is not set: it names a folder of public data sets")
    return Path(folder)
