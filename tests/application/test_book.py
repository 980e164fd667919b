"""``dronevio book``, called as on the command line."""

import importlib.util
import json
import re
from pathlib import Path

import matplotlib.image
import pytest

from dronevio.cli import main
from dronevio.models.imu_presets import IMUS


@pytest.fixture(scope="module")
def imu_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that does not exist yet."""
    return tmp_path_factory.mktemp("book") / "a" / "loop"


QUICK = ["--runs", "2", "--camera-runs", "1", "--duration-s", "5"]


def test_imu_writes_plots_and_prints_json(imu_folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "imu", "--out", str(imu_folder), *QUICK, "--counting", "equal", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["initial_error"] > 1e6 > 1e-20 > document["final_error"]
    assert document["incremental_difference"] < 1e-6
    assert document["states"] == 8 and document["factors"] == 10 and document["samples"] == [5] * 7
    assert list(document["drift"]) == list(IMUS)
    assert {study["runs"] for study in document["drift"].values()} == {2}
    assert document["drift"]["MPU-6050"]["uncalibrated_m"] > 10.0 * document["drift"]["MPU-6050"]["measured_m"]
    assert len(document["camera"]["rms_m"]) == 2  # after 2.5 s and 5 s
    for name in ("path.png", "graph.png", "drift.png", "camera.png"):
        assert_plot(imu_folder / name)
    assert (imu_folder / "graph.dot").read_text(encoding="utf-8").startswith("graph {")
    assert (imu_folder / "graph.svg").read_text(encoding="utf-8").count("<svg") == 1


def test_imu_explains_every_value(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "imu", "--out", str(tmp_path), *QUICK]) == 0
    printed = capsys.readouterr().out
    assert "6, 5, 5, 5, 5, 5; unused: 4" in printed
    modules = set(re.findall(r"dronevio\.estimator\.book\.\w+", printed))
    assert {name.rsplit(".", 1)[1] for name in modules} == {"loop", "imu", "optimization", "drift", "visual_inertial"}
    assert all(importlib.util.find_spec(name) for name in modules)
    assert printed.count("Book: section 7.4") == 6
    assert "uncalibrated [m]" in printed and "turn-on bias of 6.7 °/s" in " ".join(printed.split())
    lines = printed.splitlines()
    for start in (i for i, line in enumerate(lines) if re.fullmatch(r" +value +unit +meaning", line)):
        place, end = lines[start].index("meaning"), lines.index("", start)
        rows = lines[start + 2 : end]
        assert rows and all(len(row) > place and row[place - 2 : place] == "  " for row in rows)


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--runs", "0"], "--runs 0"), (["--duration-s", "1"], "--duration-s 1.0"), (["--imu", "best"], "'best'")],
)
def test_imu_refuses_wrong_options(words: list[str], message: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "imu", *words]) == 2
    assert message in capsys.readouterr().err


def test_sfm_writes_plot_page_and_rerun_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["book", "sfm", "--out", str(tmp_path)]) == 0
    printed = capsys.readouterr().out
    assert "5, 544" in printed and "126.9" in printed and "125.5" in printed and "error before" in printed
    assert_plot(tmp_path / "cloud.png")
    assert f"dronevio view {tmp_path}/sfm.html" in printed
    assert "</html>" in (tmp_path / "sfm.html").read_text(encoding="utf-8")
    assert (tmp_path / "cloud.rrd").stat().st_size > 200_000


def assert_plot(path: Path) -> None:
    """Check that an image file has a reasonable size and is not uniform."""
    image = matplotlib.image.imread(path)
    assert min(image.shape[:2]) > 300
    assert image[..., :3].std() > 0.05
