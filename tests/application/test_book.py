"""``dronevio book``, called as on the command line."""

import json
from pathlib import Path

import matplotlib.image
import pytest

from dronevio.cli import main


def test_imu_writes_plots_and_prints_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "imu", "--out", str(tmp_path / "a" / "loop"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["initial_error"] > 1e6 > 1e-15 > document["final_error"]
    assert document["states"] == 8 and document["factors"] == 10
    assert_plot(tmp_path / "a" / "loop" / "path.png")
    assert_plot(tmp_path / "a" / "loop" / "graph.png")
    assert (tmp_path / "a" / "loop" / "graph.dot").read_text(encoding="utf-8").startswith("graph {")


def test_sfm_writes_plot_and_rerun_file_and_prints_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "sfm", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "5, 544" in printed and "126.9" in printed and "125.5" in printed
    assert_plot(tmp_path / "cloud.png")
    assert (tmp_path / "cloud.rrd").stat().st_size > 200_000


def assert_plot(path: Path) -> None:
    """Check that an image file has a reasonable size and is not uniform."""
    image = matplotlib.image.imread(path)
    assert min(image.shape[:2]) > 300
    assert image[..., :3].std() > 0.05
