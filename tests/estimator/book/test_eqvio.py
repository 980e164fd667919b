"""The real flight that travels with gtsam: reading it, and both estimators on it."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import gtsam
import matplotlib.image
import numpy as np
import pytest

from dronevio.cli import main
from dronevio.estimator.book.eqvio import FeatureRecording, ReplayedFeatures, read_flight, run_eqvio
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.eval.metrics.alignment import align
from dronevio.models.errors import InputError
from dronevio.models.protocols import Recording
from dronevio.models.recordings.tum import read_tum

TABLE = Path(gtsam.findExampleDataFile("eqvio_processed_30s.csv"))


@pytest.fixture(scope="module")
def flight() -> FeatureRecording:
    return read_flight()


@pytest.fixture(scope="module")
def told(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[dict, Path]]:
    """Return what the command says to machines, and the folder that it wrote."""
    folder = tmp_path_factory.mktemp("book") / "deep" / "v101"
    capture = pytest.MonkeyPatch()
    lines: list[str] = []
    capture.setattr("sys.stdout.write", lines.append)
    try:
        assert main(["book", "eqvio", "--out", str(folder), "--json"]) == 0
    finally:
        capture.undo()
    yield json.loads("".join(lines)), folder


def test_flight_is_what_its_makers_say(flight: FeatureRecording) -> None:
    recording: Recording = flight
    assert len(recording.frame_times_ns) == len(flight.features) == 601
    np.testing.assert_allclose(np.diff(recording.imu.t_ns), 5_000_000, atol=1000)
    assert recording.imu.t_ns[0] <= recording.frame_times_ns[0]
    assert (recording.frame_times_ns[-1] - recording.frame_times_ns[0]) * 1e-9 == pytest.approx(30.0, abs=0.01)
    assert recording.ground_truth is None
    for ids, xy in flight.features:
        assert np.all(np.diff(ids) > 0) and xy.shape == (len(ids), 2) and np.all(np.abs(xy) < 1.5)
    assert len(np.unique(np.concatenate([ids for ids, _ in flight.features]))) == 307
    T_imu_cam = recording.rig.cameras[0].T_imu_cam
    np.testing.assert_allclose(T_imu_cam[:3, :3] @ T_imu_cam[:3, :3].T, np.eye(3), atol=1e-9)


def test_time_stamps_are_read_to_the_nanosecond(flight: FeatureRecording) -> None:
    first = next(row for row in TABLE.read_text(encoding="utf-8").splitlines() if row.startswith("imu,"))
    stamp = next(cell for cell in first.split(",") if cell.startswith("14037"))
    assert int(flight.imu.t_ns[0]) == int(stamp.replace(".", "").ljust(19, "0")[:19])


def test_wrong_features_stay_away(flight: FeatureRecording) -> None:
    front_end, buffer = ReplayedFeatures(flight), ImuBuffer()
    buffer.add(flight.imu)
    R_imu_cam = flight.rig.cameras[0].T_imu_cam[:3, :3]
    gone: set[int] = set()
    before: set[int] = set()
    for k in range(150):
        step = buffer.take_until(int(flight.frame_times_ns[k])).rotation(np.zeros(3))
        seen = front_end.track(flight.frame(k), R_imu_cam.T @ step.T @ R_imu_cam)
        ids = set(seen.ids.tolist())
        assert not ids & gone
        assert ids <= set(flight.features[k][0].tolist())
        gone |= before & set(flight.features[k][0].tolist()) - ids
        before = ids
        assert front_end.replenish() is seen
    front_end.discard(seen.ids[:3])
    after = front_end.track(flight.frame(150), np.eye(3))
    assert not set(seen.ids[:3].tolist()) & set(after.ids.tolist())


def test_two_methods_agree_on_the_real_flight(told: tuple[dict, Path]) -> None:
    summary, _ = told
    assert summary["frames"] == 601 and summary["poses"] > 540
    assert summary["ate_between_m"] < 0.10
    assert summary["largest_distance_m"] < 0.30
    assert summary["path_m"] == pytest.approx(summary["eqvio_path_m"], rel=0.1)
    assert summary["path_m"] > 5.0


def test_ours_explains_the_images_better(told: tuple[dict, Path]) -> None:
    summary, _ = told
    assert summary["ate_to_reference_m"] < summary["eqvio_ate_to_reference_m"] < 0.05
    for key in ("reprojection_median_px", "reprojection_rms_px"):
        assert summary[f"reference_{key}"] < summary[key] < summary[f"eqvio_{key}"] < 2.0


def test_files_hold_what_was_told(told: tuple[dict, Path]) -> None:
    summary, folder = told
    ours, theirs = read_tum(folder / "smoother.tum"), read_tum(folder / "eqvio.tum")
    assert len(ours) == summary["poses"] and len(theirs) == 601
    rows = np.searchsorted(theirs.t_ns, ours.t_ns)
    np.testing.assert_array_equal(theirs.t_ns[rows], ours.t_ns)
    fit = align(ours.p_world_imu, theirs.p_world_imu[rows], "yaw")
    away = np.linalg.norm(ours.p_world_imu - fit.positions(theirs.p_world_imu[rows]), axis=1)
    assert np.sqrt(np.mean(away**2)) == pytest.approx(summary["ate_between_m"], abs=1e-6)
    image = matplotlib.image.imread(folder / "paths.png")
    assert min(image.shape[:2]) > 300 and image[..., :3].std() > 0.03


def test_smoother_holds_still_while_the_drone_does(told: tuple[dict, Path]) -> None:
    """For the first seconds the drone stands on the ground, as the real images show."""
    ours = read_tum(told[1] / "smoother.tum")
    on_the_ground = ours.p_world_imu[ours.t_s < 2.0]
    assert len(on_the_ground) > 30
    assert np.linalg.norm(on_the_ground - on_the_ground[0], axis=1).max() < 0.01


def shortened(path: Path, change: Callable[[list[str]], list[str]]) -> Path:
    """Write the first second of the flight, changed."""
    rows = TABLE.read_text(encoding="utf-8").splitlines()
    meta = [row for row in rows if row.startswith(("row_type", "meta"))]
    rest = [row for row in rows if not row.startswith(("row_type", "meta"))][:800]
    path.write_text("\n".join(change([*meta, *rest])) + "\n", encoding="utf-8")
    return path


def test_filter_reports_progress_on_a_shortened_flight(tmp_path: Path) -> None:
    flight = read_flight(shortened(tmp_path / "short.csv", lambda rows: rows))
    calls: list[tuple[int, int]] = []
    path = run_eqvio(flight, lambda done, total: calls.append((done, total)))
    n = len(flight.frame_times_ns)
    assert n > 5 and calls == [(k + 1, n) for k in range(n)]
    assert np.isfinite(path.p_world_imu).all() and np.abs(path.p_world_imu).max() < 0.05 and np.all(path.cpu_ms > 0.0)


def without(start: str) -> Callable[[list[str]], list[str]]:
    return lambda rows: [row for row in rows if not row.startswith(start)]


@pytest.mark.parametrize(
    "change",
    [
        without("row_type"),
        without("imu"),
        without("vision_feature"),
        without("meta"),
        lambda rows: [row.replace(",", ";") for row in rows],
        lambda rows: [*rows, "imu," + "x" * 30],
        lambda rows: [*rows, next(row for row in rows if row.startswith("imu"))],
        lambda rows: [row.replace("T_ci_qw", "T_ci_lost") for row in rows],
        lambda rows: [row.replace("eqf.initial_point_depth", "eqf.lost") for row in rows],
    ],
    ids=[
        "no header",
        "no imu",
        "no features",
        "no settings",
        "semicolons",
        "broken row",
        "time runs backwards",
        "no mounting",
        "no depth",
    ],
)
def test_broken_tables_are_bad_input(tmp_path: Path, change: Callable[[list[str]], list[str]]) -> None:
    path = shortened(tmp_path / "broken.csv", change)
    with pytest.raises(InputError) as caught:
        run_eqvio(read_flight(path))
    assert caught.value.path == path and "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe\x00\x81", b"row_type\n\x00\n"])
def test_what_is_no_table_is_bad_input(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "none.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_flight(path)
    assert caught.value.path == path and "\n" not in str(caught.value)
