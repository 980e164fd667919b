"""Output files and folders exist complete or not at all."""

from pathlib import Path

import pytest

from dronevio.cli.output_files import atomic_file, atomic_folder, require_free, resumable, size_mb
from dronevio.models.errors import InputError


def make(target: Path, text: str, overwrite: bool = False) -> None:
    """Write a result that consists of one file in mav0."""
    with atomic_folder(target, overwrite) as folder:
        (folder / "mav0").mkdir()
        (folder / "mav0" / "data.txt").write_text(text)
        assert folder.name.startswith(".")
        assert folder.parent == target.parent


def test_folder_appears_when_complete(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "result"
    make(target, "done")
    assert (target / "mav0" / "data.txt").read_text() == "done"
    assert [file.name for file in target.parent.iterdir()] == ["result"]
    assert size_mb(target) == pytest.approx(4e-6)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_failure_leaves_no_folder(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error), atomic_folder(tmp_path / "result") as folder:
        (folder / "half").write_text("x")
        raise error
    assert list(tmp_path.iterdir()) == []


def test_interrupted_recording_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupted(frames: int) -> None:
        with atomic_folder(tmp_path / "flight") as folder:
            (folder / "mav0" / "cam0" / "data").mkdir(parents=True)
            (folder / "mav0" / "INCOMPLETE").touch()
            for frame in range(frames):
                (folder / "mav0" / "cam0" / "data" / f"{frame}.png").touch()
            raise KeyboardInterrupt

    for frames in (3, 0, 1):
        with pytest.raises(KeyboardInterrupt):
            interrupted(frames)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["flight.incomplete", "flight.incomplete-2"]
    assert len(list((tmp_path / "flight.incomplete" / "mav0" / "cam0" / "data").iterdir())) == 3
    messages = capsys.readouterr().err.splitlines()
    assert len(messages) == 2 and messages[0].endswith(str(tmp_path / "flight.incomplete"))


def test_existing_folder_is_replaced_only_with_overwrite(tmp_path: Path) -> None:
    make(tmp_path / "result", "old")
    with pytest.raises(InputError, match="--overwrite"):
        make(tmp_path / "result", "new")
    assert (tmp_path / "result" / "mav0" / "data.txt").read_text() == "old"
    make(tmp_path / "result", "new", overwrite=True)
    assert (tmp_path / "result" / "mav0" / "data.txt").read_text() == "new"
    assert [file.name for file in tmp_path.iterdir()] == ["result"]


def test_failed_replacement_keeps_the_old_folder(tmp_path: Path) -> None:
    make(tmp_path / "result", "old")
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "result", overwrite=True):
        raise KeyboardInterrupt
    assert (tmp_path / "result" / "mav0" / "data.txt").read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["result"]


def test_only_an_earlier_result_is_replaced(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    (home / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="mav0"):
        make(home, "new", overwrite=True)
    assert (home / "thesis.tex").exists()
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="it is a file"):
        make(tmp_path / "file", "new", overwrite=True)
    with pytest.raises(InputError, match="cannot be made"):
        make(tmp_path / "file" / "below", "new")


def test_empty_folder_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()
    make(tmp_path / "result", "new")
    assert (tmp_path / "result" / "mav0" / "data.txt").read_text() == "new"


def test_file_appears_when_complete(tmp_path: Path) -> None:
    target = tmp_path / "new" / "x.rrd"
    with atomic_file(target) as partial:
        partial.write_text("data")
        assert partial.name == "x.incomplete.rrd" and not target.exists()
    assert [file.name for file in target.parent.iterdir()] == ["x.rrd"]
    with pytest.raises(KeyboardInterrupt), atomic_file(target) as partial:
        partial.write_text("other")
        raise KeyboardInterrupt
    assert [file.read_text() for file in target.parent.iterdir()] == ["data"]


def test_paths_are_free_if_nothing_would_be_lost(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "file").write_text("x")
    require_free(tmp_path / "nothing", overwrite=False)
    require_free(tmp_path / "empty", overwrite=False)
    require_free(tmp_path / "file", overwrite=True)
    for taken in (tmp_path / "file", tmp_path):
        with pytest.raises(InputError, match="exists already; expected a new name, or --overwrite"):
            require_free(taken, overwrite=False)
    assert size_mb(tmp_path / "file") == pytest.approx(1e-6)


def test_a_symbolic_link_stays_and_its_target_is_written(tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    for name in ("folder", "file"):
        (tmp_path / name).symlink_to(tmp_path / "elsewhere" / name)
    with atomic_folder(tmp_path / "folder") as folder:
        (folder / "mav0").mkdir()
    with atomic_folder(tmp_path / "folder", overwrite=True) as folder:
        (folder / "mav0").write_text("new")
    with atomic_file(tmp_path / "file") as file:
        file.write_text("text")
    assert (tmp_path / "folder").is_symlink() and (tmp_path / "file").is_symlink()
    assert (tmp_path / "elsewhere" / "folder" / "mav0").read_text() == "new"
    assert (tmp_path / "elsewhere" / "file").read_text() == "text"
    assert sorted(path.name for path in tmp_path.rglob("*")) == [
        "elsewhere",
        "file",
        "file",
        "folder",
        "folder",
        "mav0",
    ]


def test_an_interruption_names_what_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for kept, text in ((tmp_path, f"finished runs are kept in {tmp_path}; the same"), (tmp_path / "missing", "")):
        with pytest.raises(KeyboardInterrupt), resumable(kept, "runs"):
            raise KeyboardInterrupt
        assert text in (error := capsys.readouterr().err) and bool(error) == bool(text)
