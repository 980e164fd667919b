"""Names of results are reserved while a process makes them."""

import subprocess
import sys
from pathlib import Path

import pytest

from dronevio.cli.output_files import atomic_folder
from dronevio.cli.reservations import reserved, reserved_free_name
from dronevio.models.errors import InputError

HOLD = """
import sys
from pathlib import Path
from dronevio.cli.output_files import atomic_folder
with atomic_folder(Path(sys.argv[1])) as folder:
    print("begun", flush=True)
    sys.stdin.readline()
    (folder / "mav0").mkdir()
"""


def start(target: Path) -> "subprocess.Popen[str]":
    """Start a process that is making a folder, until it reads a line."""
    words = [sys.executable, "-c", HOLD, str(target)]
    process = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None and process.stdout.readline() == "begun\n"
    return process


def test_a_name_in_use_is_refused_or_numbered(tmp_path: Path) -> None:
    other = start(tmp_path / "run")
    with pytest.raises(InputError, match="another process is writing it"), atomic_folder(tmp_path / "run"):
        pass
    with reserved_free_name(tmp_path / "run") as second, reserved_free_name(tmp_path / "run") as third:
        assert (second.name, third.name) == ("run-2", "run-3")
    other.communicate("\n", timeout=60)
    assert [entry.name for entry in tmp_path.iterdir()] == ["run"]
    with reserved_free_name(tmp_path / "run") as target:
        assert target.name == "run-2"


def test_a_killed_process_releases_its_name(tmp_path: Path) -> None:
    other = start(tmp_path / "run")
    other.kill()
    other.communicate(timeout=60)
    assert (tmp_path / ".run.lock").exists()
    with reserved_free_name(tmp_path / "run") as target:
        assert target.name == "run"
    with reserved(tmp_path / "run"):
        pass
    assert not (tmp_path / ".run.lock").exists()


def test_a_link_and_its_target_are_one_name(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to(tmp_path / "run")
    with (
        reserved(tmp_path / "run"),
        pytest.raises(InputError, match="another process"),
        reserved(tmp_path / "link"),
    ):
        pass


def test_a_failure_releases_the_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="half"), atomic_folder(tmp_path / "run"):
        raise ValueError("half")
    assert list(tmp_path.iterdir()) == []
