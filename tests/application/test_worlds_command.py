"""``dronevio worlds``: lists and contact sheets."""

import json
from pathlib import Path

import cv2
import pytest

from dronevio.cli import main
from dronevio.sim.world import WORLDS


def test_table_lists_every_world(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["worlds"]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in WORLDS)
    assert "hard" in printed


def test_json_lists_every_world(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["worlds", "--json", "--seed", "3"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["seed"] == 3
    assert [row["name"] for row in document["worlds"]] == list(WORLDS)
    room = document["worlds"][0]
    assert room["size_m"] == [8.0, 6.0, 3.5]
    assert room["difficulty"] == "normal"


@pytest.mark.slow
def test_contact_sheet_is_drawn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "sheet.jpg"
    assert main(["worlds", "--world", "low-texture", "--sheet", str(path), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["sheet"] == str(path)
    picture = cv2.imread(str(path))
    assert picture is not None
    assert picture.shape == (900, 1920, 3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--world", "moon"], "'moon'"),
        (["--seed", "-1"], "seed -1"),
        (["--sheet", "sheet.doc"], "'.doc'"),
        (["--sheet", "sheet"], "''"),
        (["--world", "low-texture", "--sheet", "missing/sheet.png"], "missing/sheet.png"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["worlds", *arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert message in error
    assert list(tmp_path.iterdir()) == []
