"""The section of a run's page about the map: scores, plots and values in JSON."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from matplotlib.figure import Figure

from dronevio.eval.map_results import MapResults, OnlineCorrection, map_results
from dronevio.eval.metrics import ScoredTrajectory, score_trajectory
from dronevio.eval.provenance import RunInfo
from dronevio.eval.report.map_plots import MIN_SHOWN_DEG, MIN_SHOWN_MM, draw_correction, draw_yaw_correction
from dronevio.eval.report.map_section import score_table
from dronevio.eval.report.run import write_report

if TYPE_CHECKING:
    from tests.eval.conftest import ReadPage, SyntheticFlight

INFO = RunInfo(title="a", command="b", open_command="c", seed=0, configuration={})


@pytest.fixture(scope="module")
def scored(mapped: "SyntheticFlight") -> ScoredTrajectory:
    """The odometry with its errors."""
    return score_trajectory(mapped.truth, mapped.run.trajectory, mapped.recording.frame_times_ns)


@pytest.fixture(scope="module")
def results(mapped: "SyntheticFlight") -> MapResults:
    """The map with the corrected trajectories."""
    found = map_results(mapped.run, mapped.recording)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def folder(
    mapped: "SyntheticFlight",
    scored: ScoredTrajectory,
    results: MapResults,
    tmp_path_factory: pytest.TempPathFactory,
) -> Path:
    """The folder of a report."""
    place = tmp_path_factory.mktemp("report")
    write_report(place, INFO, mapped.recording, mapped.run, scored, map_results=results)
    return place


def test_table_has_the_scores_and_their_ratios(scored: ScoredTrajectory, results: MapResults) -> None:
    rows = [[cell.text for cell in row] for row in score_table(scored, results).rows]
    assert [row[0] for row in rows] == ["odometry", "map, online", "map, final"]
    assert results.scored_final is not None
    odometry_mm, final_mm = (1e3 * s.scores.ate_m.rmse for s in (scored, results.scored_final))
    assert rows[0][1:3] == [f"{odometry_mm:.1f}", "1.00"]
    assert rows[2][1:3] == [f"{final_mm:.1f}", f"{final_mm / odometry_mm:.2f}"]


def test_page_shows_map_and_loops(folder: Path, read_page: "ReadPage") -> None:
    page = read_page((folder / "report.html").read_text(encoding="utf-8"))
    text = " ".join("".join(page.text).split())
    assert "Map and loops" in text and "Loops3" in text and "Rejected loops1" in text
    alts = " ".join(page.alts)
    assert "Pose graph before the optimization: 12 keyframes, 3 loops, 1 rejected" in alts
    for title in ("Pose graph after", "Position error with and without map", "Correction of the yaw", "Closed loops"):
        assert title in alts
    assert "corrected by the map" in text  # in the legend of the path in three dimensions


def test_json_has_the_scores_apart(folder: Path, results: MapResults, scored: ScoredTrajectory) -> None:
    document = json.loads((folder / "report.json").read_text(encoding="utf-8"))
    assert results.scored_online is not None and results.scored_final is not None
    assert document["scores"]["ate_m"]["rmse"] == scored.scores.ate_m.rmse
    assert document["map"]["online"]["ate_m"]["rmse"] == results.scored_online.scores.ate_m.rmse
    assert document["map"]["final"]["rpe_m"]["rmse"] == results.scored_final.scores.rpe_m.rmse  # type: ignore[union-attr]
    assert (document["map"]["loops"], document["map"]["rejected_loops"]) == (3, 1)


def test_without_a_map_there_is_no_section(mapped: "SyntheticFlight", scored: ScoredTrajectory, tmp_path: Path) -> None:
    write_report(tmp_path, INFO, mapped.recording, mapped.run, scored)
    assert "Map and loops" not in (tmp_path / "report.html").read_text(encoding="utf-8")
    assert json.loads((tmp_path / "report.json").read_text(encoding="utf-8"))["map"] is None


def test_without_truth_the_map_is_shown_without_scores(
    mapped: "SyntheticFlight", flight_without_truth: "SyntheticFlight", tmp_path: Path
) -> None:
    recording = flight_without_truth.recording
    write_report(tmp_path, INFO, recording, mapped.run, None, map_results=map_results(mapped.run, recording))
    html = (tmp_path / "report.html").read_text(encoding="utf-8")
    section = html[html.index("Map and loops") :]
    assert "Pose graph after" in section and not re.search("ATE.{0,4}mm", section)


def test_rounding_errors_do_not_look_like_corrections(results: MapResults) -> None:
    still, count = replace(results.map, Ts_map_imu=results.map.Ts_odom_imu + 1e-12), len(results.map.t_ns)
    rounding, no_loops = np.full(count, 1e-15), np.zeros(count, np.int64)
    correction = OnlineCorrection(still.t_ns, np.tile(rounding[:, None], 3), rounding, no_loops)
    for draw, least in ((draw_correction, MIN_SHOWN_MM), (draw_yaw_correction, MIN_SHOWN_DEG)):
        ax = Figure().subplots()
        draw(ax, correction, still, 0)
        assert ax.get_ylim() == pytest.approx((-least, least), rel=1e-3)
