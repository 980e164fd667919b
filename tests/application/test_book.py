"""``dronevio book``, called as at the terminal."""

import json
from pathlib import Path

import matplotlib.image
import pytest

from dronevio.book import EXPERIMENTS
from dronevio.cli import main


@pytest.mark.parametrize("arguments", [[], ["--help"]])
def test_book_lists_its_experiments(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", *arguments]) == 0
    printed = capsys.readouterr().out
    assert all(name in printed for name in EXPERIMENTS) and "examples:" in printed


def test_unknown_experiment_is_bad_input(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "cooking"]) == 2
    assert "'cooking'; expected one of imu, sfm" in capsys.readouterr().err


def test_imu_draws_and_tells_machines(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "imu", "--out", str(tmp_path / "a" / "loop"), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["initial_error"] > 1e6 > 1e-15 > told["final_error"]
    assert told["states"] == 8 and told["factors"] == 10
    assert_drawn(tmp_path / "a" / "loop" / "path.png")
    assert_drawn(tmp_path / "a" / "loop" / "graph.png")
    assert (tmp_path / "a" / "loop" / "graph.dot").read_text(encoding="utf-8").startswith("graph {")


def test_sfm_draws_records_and_prints_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "sfm", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "5, 544" in printed and "126.9" in printed and "125.5" in printed
    assert_drawn(tmp_path / "cloud.png")
    assert (tmp_path / "cloud.rrd").stat().st_size > 200_000


def assert_drawn(path: Path) -> None:
    image = matplotlib.image.imread(path)
    assert min(image.shape[:2]) > 300
    assert image[..., :3].std() > 0.05
