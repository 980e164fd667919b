"""Recordings that begin later or are repeated, alone and as flights of a benchmark."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.benchmark.jobs import excerpts, recorded_flights
from dronevio.cli import main
from dronevio.estimators.registry import estimator_named
from dronevio.eval.benchmark.rows import read_rows
from dronevio.models.errors import ConfigError
from dronevio.models.protocols import Recording, measurements
from dronevio.models.state import CameraFrame
from dronevio.recording.excerpts import RecordingTail, RepeatedRecording, SplicedRecording, excerpt_of

Result = Any  # the class of conftest, which cannot be imported
CommandRunner = Callable[..., Result]


@pytest.mark.parametrize("laps", [1, 3])
def test_a_repeated_recording_is_continuous(noise_recording: Callable[..., Recording], laps: int) -> None:
    one = noise_recording(frames=4)
    flown = RepeatedRecording(one, laps)
    assert len(flown.frame_times_ns) == 4 * laps and flown.lap_ns == 4 * 50_000_000
    assert np.all(np.diff(flown.frame_times_ns) == 50_000_000)
    assert np.all(np.diff(flown.imu.t_ns) > 0) and len(flown.imu) == 37 * laps  # from the first frame on
    first, last = flown.frame(1), flown.frame(4 * (laps - 1) + 1)
    np.testing.assert_array_equal(first.images[0], last.images[0])
    assert last.t_ns - first.t_ns == (laps - 1) * flown.lap_ns
    truth, repeated = one.ground_truth, flown.ground_truth
    assert truth is not None and truth.gyro_bias_rad_s is not None and repeated is not None
    change = truth.gyro_bias_rad_s[-1] - truth.gyro_bias_rad_s[0]
    per_lap = len(flown.imu) // laps
    difference = flown.imu.gyro_rad_s[-per_lap:] - flown.imu.gyro_rad_s[:per_lap]
    np.testing.assert_allclose(difference, np.tile((laps - 1) * change, (per_lap, 1)), atol=1e-12)
    metres, degrees = flown.discontinuity()
    assert metres == pytest.approx(np.linalg.norm(truth.p_world_imu[-1] - truth.p_world_imu[0])) and degrees > 0.0
    assert np.all(np.diff(repeated.t_ns) > 0) and len(repeated) == 37 * laps
    np.testing.assert_array_equal(repeated.p_world_imu[-37:], truth.p_world_imu[3:])


def test_only_a_closed_flight_is_repeated(noise_recording: Callable[..., Recording]) -> None:
    with pytest.raises(
        ConfigError, match=r"noise ends .* m and .*° from its first pose; expected at most 0.1 m and 1°"
    ):
        RepeatedRecording.of(noise_recording(), 2)
    with pytest.raises(ConfigError, match="noise ends inf m"):
        RepeatedRecording.of(replace(noise_recording(), ground_truth=None), 2)  # type: ignore[type-var]


def test_a_later_start_has_no_earlier_measurement(noise_recording: Callable[..., Recording]) -> None:
    whole = noise_recording(frames=6)
    assert excerpt_of(whole) is whole
    tail = RecordingTail.after(whole, 0.101)  # within the tolerance of the stamp of the third frame
    np.testing.assert_array_equal(tail.frame_times_ns, whole.frame_times_ns[2:])
    begin_ns = int(tail.frame_times_ns[0]) - 10_000_000
    truth = tail.ground_truth
    assert truth is not None and truth.t_ns[0] >= begin_ns and whole.imu.t_ns[0] < begin_ns < tail.imu.t_ns[0]
    frames = [each for each in measurements(tail) if isinstance(each, CameraFrame)]
    assert [frame.t_ns for frame in frames] == whole.frame_times_ns[2:].tolist()
    np.testing.assert_array_equal(frames[0].images[0], whole.frame(2).images[0])
    with pytest.raises(ConfigError, match=r"noise ends after 0\.25 s"):
        RecordingTail.after(whole, 0.3)


@pytest.mark.slow
def test_starts_and_laps_are_rows_of_their_own(flown: Result, run_command: CommandRunner, tmp_path: Path) -> None:
    common = ["--recordings", flown.folder, "--estimators", "vio", "--out", tmp_path / "rows", "--json"]
    begun = run_command(tmp_path, "benchmark", *common, "--starts-s", "0", "1.5").document["rows"]
    (twice,) = run_command(tmp_path, "benchmark", *common, "--laps", "2").document["rows"]
    name = flown.folder.name
    assert [row["scenario"] for row in begun] == [f"{name}@0s", f"{name}@1.5s"]
    early, late = begun
    assert early["status"] == late["status"] == twice["status"] == "ok"
    assert early["recording_hash"] == late["recording_hash"] == twice["recording_hash"]
    assert early["duration_s"] - late["duration_s"] == pytest.approx(1.5)
    assert twice["scenario"] == f"{name}×2"
    assert twice["duration_s"] == pytest.approx(2.0 * early["duration_s"] + 0.05)
    assert twice["ate_m"] < 0.05 and twice["cpu_growth"] > 0.0 and early["nees_velocity"] > 0.0
    assert len(read_rows(tmp_path / "rows")) == 3
    assert late["start_s"] < 3.0 and late["start_speed_m_s"] is not None


def test_starts_that_cannot_be_are_refused(flown: Result, capsys: pytest.CaptureFixture[str]) -> None:
    flights = recorded_flights([flown.folder])
    for starts, laps, found in (((0.0, 0.0), 1, "different times"), ((-1.0,), 1, "from 0 s on"), ((1.0,), 2, "one of")):
        with pytest.raises(ConfigError, match=found):
            excerpts(flights, starts, laps)
    program = "p=external:cat {recording} {output}"
    assert main(["benchmark", "--recordings", str(flown.folder), "--laps", "2", "--estimators", program]) == 2
    assert "--starts-s or --laps with p: a program reads a whole recording once" in capsys.readouterr().err
    with pytest.raises(ConfigError, match="expected no starts and laps"):
        estimator_named(program).run(flown.folder, start_s=1.0)


def test_a_spliced_recording_continues_with_another_part(noise_recording: Callable[..., Recording]) -> None:
    first, second = noise_recording(), noise_recording()
    spliced = SplicedRecording.at(first, 0.1, second, 0.05)
    step_ns = int(np.diff(first.frame_times_ns)[0])
    assert np.all(np.diff(spliced.frame_times_ns) == step_ns) and np.all(np.diff(spliced.imu.t_ns) > 0)
    assert np.diff(spliced.imu.t_ns).max() <= step_ns
    row = int(np.searchsorted(spliced.frame_times_ns, spliced.splice_ns))
    begun = int(np.searchsorted(second.frame_times_ns, second.frame_times_ns[0] + 50_000_000))
    assert np.array_equal(spliced.frame(row).images[0], second.frame(begun).images[0])
    assert np.array_equal(spliced.frame(row - 1).images[0], first.frame(row - 1).images[0])
    assert spliced.frame(row).t_ns == spliced.splice_ns
    late = spliced.imu.t_ns >= spliced.splice_ns
    later = second.imu.t_ns >= second.frame_times_ns[begun]
    assert np.array_equal(spliced.imu.gyro_rad_s[late], second.imu.gyro_rad_s[later])


def test_a_splice_outside_a_recording_is_refused(noise_recording: Callable[..., Recording]) -> None:
    with pytest.raises(ConfigError, match="a splice at 500 s; noise has frames from 0 to"):
        SplicedRecording.at(noise_recording(), 500.0, noise_recording(), 1.0)
