"""Reports of runs: self-contained pages, escaped text, and figures equal to those of the scores."""

import base64
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from dronevio.eval.metrics import ScoredTrajectory, score_trajectory
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.plots import STATE_ERRORS, length_errors
from dronevio.eval.report.run import write_report
from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import EvaluationError
from tests.browser import Browser

if TYPE_CHECKING:
    from tests.eval.conftest import Page, ReadPage, SyntheticFlight

INFO = RunInfo(
    title="A <script>alert(1)</script> & flight",
    command="dronevio run --seed 3",
    open_command="dronevio view 'runs/<third>'",
    seed=3,
    configuration={"estimator": {"window_s": 5.0, "names": ("a", "<b>")}, "scenario": {"wind": None}},
)
HOSTILE = """</style></title></td><script>alert('1')</script>{{ 7 * 7 }}{% raw %}& <b> "quoted\""""


@pytest.fixture(scope="module")
def scored(flight: "SyntheticFlight") -> ScoredTrajectory:
    """Return the errors of the estimate."""
    return score_trajectory(flight.truth, flight.run.trajectory, flight.recording.frame_times_ns)


@pytest.fixture(scope="module")
def folder(flight: "SyntheticFlight", scored: ScoredTrajectory, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the report of the flight."""
    folder = tmp_path_factory.mktemp("report")
    write_report(folder, INFO, flight.recording, flight.run, scored, outline=flight.outline)
    return folder


@pytest.fixture(scope="module")
def html(folder: Path) -> str:
    """Return the source of the report."""
    return (folder / "report.html").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def page(html: str, read_page: "ReadPage") -> "Page":
    """Return the parsed report."""
    return read_page(html)


@pytest.fixture(scope="module")
def numbers(folder: Path) -> dict[str, Any]:
    """Return the content of the JSON report."""
    numbers: dict[str, Any] = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    return numbers


def test_the_page_is_self_contained(html: str, page: "Page") -> None:
    assert all(link.startswith(("data:image/jpeg;base64,", "#")) for link in page.links)
    assert page.tags.count("script") == 1
    assert not {"link", "iframe", "object", "img"} & set(page.tags)
    assert not re.search(r"url\((?!#)|@import", html)
    assert "http" not in re.sub(r'"http://www\.w3\.org/(2000/svg|1999/xlink)"', "", html)  # XML namespaces


def test_text_of_the_run_is_escaped(html: str, page: "Page") -> None:
    text = "".join(page.text)
    assert html.count("<script>") == 1  # that of the path in three dimensions
    assert INFO.title in text
    assert INFO.open_command in text
    assert "a, <b>" in text


def test_names_with_html_are_shown_as_text(flight: "SyntheticFlight", tmp_path: Path, read_page: "ReadPage") -> None:
    info = RunInfo(HOSTILE, HOSTILE, HOSTILE, 0, {HOSTILE: HOSTILE}, {HOSTILE: HOSTILE}, {HOSTILE: HOSTILE})
    write_report(tmp_path, info, replace(flight.recording, name=HOSTILE), flight.run, None)
    html = (tmp_path / "report.html").read_text()
    page = read_page(html)
    assert page.tags.count("script") == 1 and html.count("<title>") == 1
    # Title, heading, the commands that open and produce the run, and names and values of three tables.
    assert "".join(page.text).count(HOSTILE) == 10


def test_the_page_shows_the_scores(page: "Page", scored: ScoredTrajectory) -> None:
    text = " ".join("".join(page.text).split())
    scores = scored.scores
    assert scores.rpe_m is not None
    for value in (
        f"ATE{scores.ate_m.rmse:.4f} m",
        f"RPE{scores.rpe_m.rmse:.4f} m",
        f"Coverage{scores.coverage_percent:.1f} %",
        f"Scale error{scores.scale_error_percent:+.2f} %".replace("-", "−"),
        "seed3",
        "estimator.window_s5",
    ):
        assert value in text


def test_json_holds_the_scores_and_statistics(
    numbers: dict[str, Any], flight: "SyntheticFlight", scored: ScoredTrajectory
) -> None:
    assert numbers["format"] == "dronevio-report/1"
    assert numbers["scores"]["ate_m"]["rmse"] == scored.scores.ate_m.rmse
    truth = flight.truth
    assert truth.velocity_m_s is not None
    assert numbers["flight"]["path_m"] == truth.length_m
    assert numbers["flight"]["peak_speed_m_s"] == np.linalg.norm(truth.velocity_m_s, axis=1).max()
    assert numbers["flight"]["duration_s"] == pytest.approx(6.0)
    assert numbers["timing"]["cpu_ms_mean"] == flight.run.cpu_ms.mean()
    assert numbers["timing"]["cpu_ms_p99"] == np.percentile(flight.run.cpu_ms, 99)
    assert numbers["estimator"] == {
        "poses": 111,
        "first_pose_s": pytest.approx(0.5),
        "mean_tracks": flight.run.n_tracks.mean(),
        "keyframes": sum("keyframe" in e.events for e in flight.run.estimates),
        "health": {"initializing": 10, "tracking": 111},
        "innovations": None,
        "warnings": [],
    }
    assert numbers["configuration"]["scenario"] == {"wind": None}
    assert numbers["seed"] == 3
    assert numbers["versions"]["numpy"] == np.__version__
    assert int(numbers["machine"]["cores"]) >= 1


def test_the_page_has_a_plot_of_each_known_quantity(page: "Page", scored: ScoredTrajectory) -> None:
    text = " ".join("".join(page.text).split())
    for title in (
        "Path from above",
        "Path from the side",
        "Position error over time",
        "Velocity error over time",
        "Gyroscope bias error over time",
        "Accelerometer bias error over time",
        "Relative position error",
        "Relative orientation error",
        "Consistency: NEES over time",
        "Distribution of the processor time",
    ):
        assert title in text
    scores = scored.scores
    assert scores.nees_position is not None and scores.nees_position_inside_percent is not None
    assert f"position{scores.nees_position:.2f}{scores.nees_position_inside_percent:.1f}" in text
    assert f"at most {scores.ate_m.max:.3f} m" in next(
        alt for alt in page.alts if alt.startswith("Position error over time")
    )


def test_every_plot_has_a_title_and_every_axis_a_unit(page: "Page", html: str) -> None:
    others = 4 + 3  # camera images; the path in three dimensions with two keys of its legend
    assert len(page.alts) == html.count("<svg") == html.count('<svg role="img"') + others
    assert all(page.alts)
    plots = [part.partition("</svg>")[0] for part in html.split('<svg role="img"')[1:]]
    for plot in plots:
        labels = re.findall(r">([^<>]*)</text>", plot)
        assert sum("[" in label or label.startswith("number of") for label in labels) == 2, labels


def test_errors_by_length_are_those_of_the_scores(scored: ScoredTrajectory) -> None:
    plotted = length_errors(scored)
    lengths = scored.scores.lengths
    assert len(plotted.labels) == len(lengths) > 3
    for errors, percent, deg in zip(lengths, plotted.translation_percent, plotted.rotation_deg, strict=True):
        assert np.median(percent) == pytest.approx(errors.translation_percent.median, rel=1e-12)
        assert deg.max() == pytest.approx(errors.rotation_deg.max, rel=1e-12)


def test_state_errors_need_both_truth_and_estimate(scored: ScoredTrajectory) -> None:
    assert all(quantity.is_known(scored) for quantity in STATE_ERRORS)
    without_gyro_bias = replace(scored, truth=replace(scored.truth, gyro_bias_rad_s=None))
    assert [quantity.is_known(without_gyro_bias) for quantity in STATE_ERRORS] == [True, False, True]


def test_plots_use_the_colours_of_the_page(html: str) -> None:
    assert "var(--ink)" in html
    assert "#1f2328" not in html.split("</style>", 1)[1]


def test_sample_frames_are_the_images_with_their_tracks(page: "Page", html: str, flight: "SyntheticFlight") -> None:
    pictures = [link for link in page.links if link.startswith("data:image/jpeg")]
    assert len(pictures) == 4
    captions = re.findall(r"<figcaption>([\d.]+) s: (\d+) tracks", html)
    circles = [part.count("<circle") for part in html.split('<svg class="frame"')[1:]]
    for picture, (seconds, count), drawn_count in zip(pictures, captions, circles, strict=True):
        index = round(float(seconds) / 0.05)
        data = base64.b64decode(picture.partition(",")[2])
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        assert np.mean(np.abs(image.astype(float) - flight.recording.frame(index).images[0])) < 5.0
        assert int(count) == drawn_count == flight.run.n_tracks[index]


def test_the_image_of_the_trajectory_shows_the_estimate(folder: Path) -> None:
    image = cv2.imread(str(folder / "trajectory.png"))
    assert image is not None
    assert image.shape[1] == 1600
    vermilion = np.all(np.abs(image.astype(int) - [0x00, 0x5E, 0xD5]) < 12, axis=2)  # BGR
    assert vermilion.sum() > 500
    assert np.all(image[0, 0] == 255)


def test_the_same_run_gives_the_same_bytes(
    folder: Path, flight: "SyntheticFlight", scored: ScoredTrajectory, tmp_path: Path
) -> None:
    write_report(tmp_path, INFO, flight.recording, flight.run, scored, outline=flight.outline)
    for name in ("report.html", "report.json", "trajectory.png"):
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()


def test_without_truth_the_report_has_no_errors(
    flight_without_truth: "SyntheticFlight", tmp_path: Path, read_page: "ReadPage"
) -> None:
    write_report(tmp_path, replace(INFO, seed=None), flight_without_truth.recording, flight_without_truth.run, None)
    numbers = json.loads((tmp_path / "report.json").read_text())
    assert numbers["scores"] is None
    assert numbers["flight"]["path_m"] == flight_without_truth.run.trajectory.length_m
    text = "".join(read_page((tmp_path / "report.html").read_text()).text)
    assert "ATE" not in text
    assert "sub-trajectory length" not in text
    assert "Position error" not in text


def test_without_covariances_the_report_has_no_nees(
    flight: "SyntheticFlight", tmp_path: Path, read_page: "ReadPage"
) -> None:
    estimates = tuple(
        e if e.state is None else replace(e, state=replace(e.state, covariance=None)) for e in flight.run.estimates
    )
    run = replace(flight.run, estimates=estimates)
    scored = score_trajectory(flight.truth, run.trajectory)
    write_report(tmp_path, INFO, flight.recording, run, scored)
    text = "".join(read_page((tmp_path / "report.html").read_text()).text)
    assert "Position error over time" in text
    assert "3σ" not in text
    assert "NEES" not in text


def test_the_report_of_a_run_without_poses(flight: "SyntheticFlight", tmp_path: Path, read_page: "ReadPage") -> None:
    estimates = tuple(replace(e, state=None, tracks=None) for e in flight.run.estimates)
    run = EstimatorRun(estimates, 0 * flight.run.cpu_ms, flight.run.wall_ms)
    write_report(tmp_path, INFO, flight.recording, run, None)
    numbers = json.loads((tmp_path / "report.json").read_text())
    assert numbers["estimator"]["first_pose_s"] is None
    assert numbers["timing"]["real_time_factor"] is None
    text = "".join(read_page((tmp_path / "report.html").read_text()).text)
    assert INFO.title in text and "Position error over time" not in text


def test_a_run_of_another_recording_is_refused(flight: "SyntheticFlight", tmp_path: Path) -> None:
    other = replace(flight.recording, frame_times_ns=flight.recording.frame_times_ns + 1)
    with pytest.raises(EvaluationError):
        write_report(tmp_path, INFO, other, flight.run, None)
    assert list(tmp_path.iterdir()) == []


def test_the_page_in_a_browser(folder: Path, browser: Browser) -> None:
    assert browser.faults((folder / "report.html").as_uri()) == []
    assert browser.evaluate("document.querySelectorAll('.tile').length") == 8
