"""Folders that are there whole or not at all."""

from pathlib import Path

import pytest

from dronevio.cli.folders import atomic_folder, size_mb
from dronevio.models.errors import InputError


def make(target: Path, text: str, overwrite: bool = False) -> None:
    """Write a result of one file under mav0."""
    with atomic_folder(target, overwrite) as folder:
        (folder / "mav0").mkdir()
        (folder / "mav0" / "data.txt").write_text(text)
        assert folder.name.startswith(".")
        assert folder.parent == target.parent


def test_it_appears_at_the_end(tmp_path: Path) -> None:
    target = tmp_path / "deep" / "result"
    make(target, "done")
    assert (target / "mav0" / "data.txt").read_text() == "done"
    assert [file.name for file in target.parent.iterdir()] == ["result"]
    assert size_mb(target) == pytest.approx(4e-6)


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError])
def test_nothing_is_left_of_a_failure(tmp_path: Path, error: type[BaseException]) -> None:
    with pytest.raises(error), atomic_folder(tmp_path / "result") as folder:
        (folder / "half").write_text("x")
        raise error
    assert list(tmp_path.iterdir()) == []


def test_a_recording_that_was_cut_off_is_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def cut_off(frames: int) -> None:
        with atomic_folder(tmp_path / "flight") as folder:
            (folder / "mav0" / "cam0" / "data").mkdir(parents=True)
            (folder / "mav0" / "INCOMPLETE").touch()
            for frame in range(frames):
                (folder / "mav0" / "cam0" / "data" / f"{frame}.png").touch()
            raise KeyboardInterrupt

    for frames in (3, 0, 1):
        with pytest.raises(KeyboardInterrupt):
            cut_off(frames)
    assert sorted(file.name for file in tmp_path.iterdir()) == ["flight.incomplete", "flight.incomplete-2"]
    assert len(list((tmp_path / "flight.incomplete" / "mav0" / "cam0" / "data").iterdir())) == 3
    told = capsys.readouterr().err.splitlines()
    assert len(told) == 2 and told[0].endswith(str(tmp_path / "flight.incomplete"))


def test_what_is_there_is_not_replaced_unasked(tmp_path: Path) -> None:
    make(tmp_path / "result", "old")
    with pytest.raises(InputError, match="--overwrite"):
        make(tmp_path / "result", "new")
    assert (tmp_path / "result" / "mav0" / "data.txt").read_text() == "old"
    make(tmp_path / "result", "new", overwrite=True)
    assert (tmp_path / "result" / "mav0" / "data.txt").read_text() == "new"
    assert [file.name for file in tmp_path.iterdir()] == ["result"]


def test_a_failed_replacement_keeps_the_old(tmp_path: Path) -> None:
    make(tmp_path / "result", "old")
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "result", overwrite=True):
        raise KeyboardInterrupt
    assert (tmp_path / "result" / "mav0" / "data.txt").read_text() == "old"
    assert [file.name for file in tmp_path.iterdir()] == ["result"]


def test_only_our_own_is_replaced(tmp_path: Path) -> None:
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


def test_an_empty_folder_is_no_obstacle(tmp_path: Path) -> None:
    (tmp_path / "result").mkdir()
    make(tmp_path / "result", "new")
    assert (tmp_path / "result" / "mav0" / "data.txt").read_text() == "new"
