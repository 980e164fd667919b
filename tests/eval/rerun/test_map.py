"""The map in a recording: loops, points, pose graph, corrected path and correction over time."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from rerun.chunk import RrdReader

from dronevio.eval import colours
from dronevio.eval.map_results import MapResults, map_results, online_correction
from dronevio.eval.metrics import score_trajectory
from dronevio.eval.rerun.entities import CORRECTION_YAW, EstimateEntities
from dronevio.eval.rerun.files import ESTIMATE, write_rrd

if TYPE_CHECKING:
    from tests.eval.conftest import EntityColumns, ReadRrd, SyntheticFlight, VerifyRrd

LOGGED = EstimateEntities(ESTIMATE).map


@pytest.fixture(scope="module")
def results(mapped: "SyntheticFlight") -> MapResults:
    """The map with the corrected trajectories."""
    found = map_results(mapped.run, mapped.recording)
    assert found is not None
    return found


@pytest.fixture(scope="module")
def rrd(mapped: "SyntheticFlight", results: MapResults, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The file of a run with a map."""
    path = tmp_path_factory.mktemp("rerun") / "run.rrd"
    scored = score_trajectory(mapped.truth, mapped.run.trajectory, mapped.recording.frame_times_ns)
    write_rrd(path, mapped.recording, mapped.run, scored, mapped=results)
    return path


@pytest.fixture(scope="module")
def columns(rrd: Path, read_rrd: "ReadRrd") -> "EntityColumns":
    """The content of the file."""
    return read_rrd(rrd)


def rgb_of(packed: int) -> tuple[int, int, int]:
    """Return the colour of a packed one, red first."""
    return packed >> 24, packed >> 16 & 255, packed >> 8 & 255


def test_the_file_is_valid(rrd: Path, verify_rrd: "VerifyRrd") -> None:
    verify_rrd(rrd)


def test_loops_connect_their_keyframes(columns: "EntityColumns", results: MapResults) -> None:
    p = results.final_alignment.positions(results.map.Ts_map_imu[:, :3, 3])
    closed, rejected = (np.array(columns[name]["strips"][0].as_py()) for name in (LOGGED.loops, LOGGED.rejected_loops))
    np.testing.assert_allclose(closed, p[[[0, 6], [1, 6], [2, 7]]], atol=1e-5)
    np.testing.assert_allclose(rejected, p[[[3, 8]]], atol=1e-5)
    shades = [columns[name]["colors"][0].as_py()[0] for name in (LOGGED.loops, LOGGED.rejected_loops)]
    assert [rgb_of(shade) for shade in shades] == [colours.rgb(colours.LOOP), colours.rgb(colours.REJECTED_LOOP)]


def test_graph_is_logged_before_and_after(
    columns: "EntityColumns", results: MapResults, mapped: "SyntheticFlight"
) -> None:
    before, after = (
        np.array(columns[name]["strips"][0].as_py()[0]) for name in (LOGGED.graph_before, LOGGED.graph_after)
    )
    np.testing.assert_allclose(after, mapped.truth.p_world_imu[100::100], atol=2e-3)
    assert np.linalg.norm(before - after, axis=1).max() > 0.005  # the drift
    points = np.array(columns[LOGGED.points]["positions"][0].as_py())
    np.testing.assert_allclose(points, results.final_alignment.positions(results.map.points), atol=1e-5)


def test_correction_is_a_curve_over_time(columns: "EntityColumns", mapped: "SyntheticFlight") -> None:
    expected = online_correction(mapped.run.estimates)
    position, yaw, loops = (
        np.array(columns[name]["scalars"].to_pylist()) for name in (LOGGED.position, LOGGED.yaw, LOGGED.loop_count)
    )
    np.testing.assert_allclose(position, expected.position_m)
    np.testing.assert_allclose(yaw[:, 0], expected.yaw_deg)
    assert loops[:, 0].tolist() == [0.0] * 70 + [2.0] * 10 + [3.0] * 31


def test_corrected_path_grows_over_time(columns: "EntityColumns", results: MapResults) -> None:
    p = results.online_alignment.positions(results.online.p_world_imu)
    strips = np.array([row[0] for row in columns[LOGGED.path_so_far]["strips"].to_pylist() if row])
    np.testing.assert_allclose(strips, np.stack([p[:-1], p[1:]], axis=1), atol=1e-5)


def test_only_runs_with_a_map_have_its_plots(rrd: Path, mapped: "SyntheticFlight", tmp_path: Path) -> None:
    other = tmp_path / "run.rrd"
    write_rrd(other, mapped.recording, replace(mapped.run, map=None), None)
    assert [CORRECTION_YAW in origins(path) for path in (rrd, other)] == [True, False]


def origins(path: Path) -> set[str]:
    """Return the origins of the views of a file."""
    reader = RrdReader(path)
    found: set[str] = set()
    for chunk in reader.stream(store=reader.blueprints()[0]):
        batch = chunk.to_record_batch()
        for name in filter(lambda name: name.endswith(":space_origin"), batch.schema.names):
            found |= {text.strip("/") for row in batch.column(name).to_pylist() for text in row or ()}
    return found
