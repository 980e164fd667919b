"""The recording that comes with the gtsam package: reading it, and both estimators on it."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gtsam
import matplotlib.image
import numpy as np
import pytest

from dronevio.cli import main
from dronevio.estimator.book.eqvio import FeatureRecording, ReplayFrontEnd, read_feature_recording, run_eqvio
from dronevio.estimator.imu.buffer import ImuBuffer
from dronevio.eval.metrics.alignment import align
from dronevio.models.errors import InputError
from dronevio.models.protocols import Recording
from dronevio.models.recordings.tum import read_tum

Summary = tuple[dict[str, Any], Path]
Change = Callable[[list[str]], list[str]]

TABLE = Path(gtsam.findExampleDataFile("eqvio_processed_30s.csv"))


@pytest.fixture(scope="module")
def recording() -> FeatureRecording:
    return read_feature_recording()


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Summary]:
    """The JSON document of ``dronevio book eqvio``, and the folder that it wrote."""
    folder = tmp_path_factory.mktemp("book") / "deep" / "v101"
    capture = pytest.MonkeyPatch()
    lines: list[str] = []
    capture.setattr("sys.stdout.write", lines.append)
    try:
        assert main(["book", "eqvio", "--out", str(folder), "--json"]) == 0
    finally:
        capture.undo()
    yield json.loads("".join(lines)), folder


def test_recording_has_the_documented_contents(recording: FeatureRecording) -> None:
    as_protocol: Recording = recording
    assert as_protocol.ground_truth is None
    assert len(recording.frame_times_ns) == len(recording.features) == 601
    np.testing.assert_allclose(np.diff(recording.imu.t_ns), 5_000_000, atol=1000)
    assert recording.imu.t_ns[0] <= recording.frame_times_ns[0]
    assert (recording.frame_times_ns[-1] - recording.frame_times_ns[0]) * 1e-9 == pytest.approx(30.0, abs=0.01)
    for ids, xy in recording.features:
        assert np.all(np.diff(ids) > 0) and xy.shape == (len(ids), 2) and np.all(np.abs(xy) < 1.5)
    assert len(np.unique(np.concatenate([ids for ids, _ in recording.features]))) == 307
    T_imu_cam = recording.rig.cameras[0].T_imu_cam
    np.testing.assert_allclose(T_imu_cam[:3, :3] @ T_imu_cam[:3, :3].T, np.eye(3), atol=1e-9)


def test_time_stamps_are_exact_to_the_nanosecond(recording: FeatureRecording) -> None:
    first = next(row for row in TABLE.read_text(encoding="utf-8").splitlines() if row.startswith("imu,"))
    stamp = next(cell for cell in first.split(",") if cell.startswith("14037"))
    assert int(recording.imu.t_ns[0]) == int(stamp.replace(".", "").ljust(19, "0")[:19])


def test_rejected_features_do_not_return(recording: FeatureRecording) -> None:
    front_end, buffer = ReplayFrontEnd(recording), ImuBuffer()
    buffer.add(recording.imu)
    R_imu_cam = recording.rig.cameras[0].T_imu_cam[:3, :3]
    rejected: set[int] = set()
    previous: set[int] = set()
    for k in range(150):
        R = buffer.take_until(int(recording.frame_times_ns[k])).rotation(np.zeros(3))
        observations = front_end.track(recording.frame(k), R_imu_cam.T @ R.T @ R_imu_cam)
        ids, recorded = set(observations.ids.tolist()), set(recording.features[k][0].tolist())
        assert not ids & rejected
        assert ids <= recorded
        rejected |= previous & recorded - ids
        previous = ids
        assert front_end.replenish() is observations
    assert rejected
    front_end.discard(observations.ids[:3])
    after = front_end.track(recording.frame(150), np.eye(3))
    assert not set(observations.ids[:3].tolist()) & set(after.ids.tolist())


def test_both_estimators_agree(result: Summary) -> None:
    summary, _ = result
    assert summary["frames"] == 601 and summary["poses"] > 540
    assert summary["ate_between_m"] < 0.10
    assert summary["largest_distance_m"] < 0.30
    assert summary["path_m"] == pytest.approx(summary["eqvio_path_m"], rel=0.1)
    assert summary["path_m"] > 5.0


def test_the_smoother_explains_the_images_better(result: Summary) -> None:
    summary, _ = result
    assert summary["ate_to_reference_m"] < summary["eqvio_ate_to_reference_m"] < 0.05
    for key in ("reprojection_median_px", "reprojection_rms_px"):
        assert summary[f"reference_{key}"] < summary[key] < summary[f"eqvio_{key}"] < 2.0


def test_files_agree_with_the_summary(result: Summary) -> None:
    summary, folder = result
    smoother, eqvio = read_tum(folder / "smoother.tum"), read_tum(folder / "eqvio.tum")
    assert len(smoother) == summary["poses"] and len(eqvio) == 601
    rows = np.searchsorted(eqvio.t_ns, smoother.t_ns)
    np.testing.assert_array_equal(eqvio.t_ns[rows], smoother.t_ns)
    fit = align(smoother.p_world_imu, eqvio.p_world_imu[rows], "yaw")
    distance_m = np.linalg.norm(smoother.p_world_imu - fit.positions(eqvio.p_world_imu[rows]), axis=1)
    assert np.sqrt(np.mean(distance_m**2)) == pytest.approx(summary["ate_between_m"], abs=1e-6)
    image = matplotlib.image.imread(folder / "paths.png")
    assert min(image.shape[:2]) > 300 and image[..., :3].std() > 0.03


def test_the_smoother_does_not_drift_on_the_ground(result: Summary) -> None:
    """The drone stands on the ground for the first seconds, as the images of V1_01 show."""
    smoother = read_tum(result[1] / "smoother.tum")
    on_the_ground = smoother.p_world_imu[smoother.t_s < 2.0]
    assert len(on_the_ground) > 30
    assert np.linalg.norm(on_the_ground - on_the_ground[0], axis=1).max() < 0.01


def write_shortened(path: Path, change: Change) -> Path:
    """Write the first second of the recording with a change, and return the path."""
    rows = TABLE.read_text(encoding="utf-8").splitlines()
    meta = [row for row in rows if row.startswith(("row_type", "meta"))]
    rest = [row for row in rows if not row.startswith(("row_type", "meta"))][:800]
    path.write_text("\n".join(change([*meta, *rest])) + "\n", encoding="utf-8")
    return path


def test_filter_reports_its_progress(tmp_path: Path) -> None:
    recording = read_feature_recording(write_shortened(tmp_path / "short.csv", lambda rows: rows))
    calls: list[tuple[int, int]] = []
    run = run_eqvio(recording, lambda done, total: calls.append((done, total)))
    n = len(recording.frame_times_ns)
    assert n > 5 and calls == [(k + 1, n) for k in range(n)]
    assert np.isfinite(run.p_world_imu).all() and np.abs(run.p_world_imu).max() < 0.05 and np.all(run.cpu_ms > 0.0)


def without(start: str) -> Change:
    """Return a change that removes the rows with a given start."""
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
        "decreasing time",
        "no extrinsics",
        "no depth",
    ],
)
def test_broken_tables_are_bad_input(tmp_path: Path, change: Change) -> None:
    path = write_shortened(tmp_path / "broken.csv", change)
    with pytest.raises(InputError) as caught:
        run_eqvio(read_feature_recording(path))
    assert caught.value.path == path and "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [None, b"", b"\xff\xfe\x00\x81", b"row_type\n\x00\n"])
def test_other_files_are_bad_input(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "none.csv"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(InputError) as caught:
        read_feature_recording(path)
    assert caught.value.path == path and "\n" not in str(caught.value)
