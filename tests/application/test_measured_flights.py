"""Flights of measured paths and IMU samples in benchmarks: where they exist, what they contain, and their hashes."""

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dronevio.benchmark.jobs import Workbench, measured_recordings, versions
from dronevio.benchmark.measured_flights import MEASURED, measured_flights, measured_name
from dronevio.cli import main
from dronevio.cli.commands import benchmark
from dronevio.cli.terminal import parse
from dronevio.models.errors import ConfigError
from dronevio.models.recordings.euroc import EurocRecording, read_imu
from dronevio.models.rig_presets import rig_named
from dronevio.sim.scenarios import SCENARIOS, SUITES

Result = Any  # the class of conftest, which cannot be imported


@pytest.fixture
def measured_data(flown: Result, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with the data of all measured flights, which are those of a short simulated one."""
    data, mav0 = tmp_path / "data", flown.folder / "mav0"
    for flight in MEASURED.values():
        folder = data / "euroc" / flight.flight
        folder.mkdir(parents=True)
        shutil.copy(mav0 / "state_groundtruth_estimate0" / "data.csv", folder / "groundtruth.csv")
        shutil.copy(mav0 / "imu0" / "data.csv", folder / "imu0.csv")
        short = replace(flight, world="low-texture", start_s=2.0, duration_s=0.3)
        monkeypatch.setitem(MEASURED, flight.name, short)
    monkeypatch.setenv("DRONEVIO_DATA", str(data))
    return data


def planned(*options: str) -> Sequence[Any]:
    """Return the recordings of a command."""
    arguments = options if "--seeds" in options else (*options, "--seeds", "1")
    plan = benchmark._planned(parse(benchmark.BenchmarkCommand, arguments, "benchmark"))
    return plan.recordings


def test_names_are_those_of_no_scenario() -> None:
    assert not set(MEASURED) & set(SCENARIOS)
    assert [measured_name(name) for name in ("measured-V1_02", "measured-V1_02-v0", "room-v0", "loops")] == [
        "measured-V1_02-v0", "measured-V1_02-v0", None, None,
    ]  # fmt: skip


def test_the_suite_says_what_it_leaves_out(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.delenv("DRONEVIO_DATA", raising=False)
    assert [each.scenario for each in planned("--suite", "loops")] == list(SUITES["loops"])
    (warning,) = capsys.readouterr().err.splitlines()
    assert all(name in warning for name in MEASURED) and "DRONEVIO_DATA" in warning
    assert [each.scenario for each in planned("--suite", "shapes")] == list(SUITES["shapes"])
    assert capsys.readouterr().err == ""
    assert main(["benchmark", "--scenarios", "measured-MH_04", "--out", str(tmp_path / "out")]) == 2
    assert "measured-MH_04-v0 cannot be flown: expected DRONEVIO_DATA" in capsys.readouterr().err
    monkeypatch.setenv("DRONEVIO_DATA", str(tmp_path))
    with pytest.raises(ConfigError, match=r"MH_04.groundtruth\.csv: no such file"):
        measured_flights(["measured-MH_04"])
    assert measured_flights(["loops"])[0] == () and "no such file" in measured_flights(["loops"])[1]


@pytest.mark.usefixtures("measured_data")
def test_they_join_the_suite(capsys: pytest.CaptureFixture[str]) -> None:
    flights = planned("--suite", "loops", "--rig", "euroc-stereo", "--seeds", "2", "--variants", "as-is", "reverse")
    names = [each.scenario for each in flights]
    assert [name for name in names if name.startswith("measured")] == list(MEASURED) * 2
    assert capsys.readouterr().err == ""
    assert [len(each.source.rig.cameras) for each in flights if each.scenario in MEASURED] == 6 * [2]
    assert [each.scenario for each in planned("--scenarios", "measured-V1_02")] == ["measured-V1_02-v0"]
    assert not any("measured" in each.scenario for each in planned("--suite", "loops", "--variants", "reverse"))
    assert not any("measured" in each.scenario for each in planned("--suite", "loops", "--rig", "nano"))
    assert "mounted as EuRoC's" in capsys.readouterr().err


def test_the_hash_is_that_of_data_world_and_sensors(measured_data: Path, tmp_path: Path) -> None:
    flights, _ = measured_flights(["measured-V1_02"])
    (first, second) = measured_recordings(flights, (0, 1))
    assert first.recording_hash != second.recording_hash
    (moved,) = measured_recordings(
        [replace(flights[0], folder=shutil.copytree(flights[0].folder, tmp_path / "m"))], [0]
    )
    assert moved.recording_hash == first.recording_hash
    (stereo,) = measured_recordings([replace(flights[0], rig=rig_named("euroc-stereo"))], [0])
    (sensor,) = measured_recordings(flights, [0], "vi-sensor")
    with (measured_data / "euroc" / "V1_02" / "imu0.csv").open("a") as file:
        file.write("9000000000,0,0,0,0,0,9.81\n")
    (other,) = measured_recordings(flights, [0])
    assert len({each.recording_hash for each in (first, stereo, sensor, other)}) == 4


@pytest.mark.slow
def test_the_recording_has_the_measured_samples(measured_data: Path, tmp_path: Path) -> None:
    """The same flight gives the same bytes."""
    flights, _ = measured_flights(["measured-V1_02"])
    (spec,), folders = measured_recordings(flights, [3]), (tmp_path / "one", tmp_path / "two")
    for folder in folders:
        Workbench((), versions()).record(spec, folder)
    one, two = ({f.relative_to(d): f.read_bytes() for d in [e] for f in d.rglob("*") if f.is_file()} for e in folders)
    assert one == two and sum(path.suffix == ".png" for path in one) == 6
    recording, samples = EurocRecording.open(folders[0]), read_imu(measured_data / "euroc" / "V1_02" / "imu0.csv")
    rows = np.isin(samples.t_ns, recording.imu.t_ns)
    np.testing.assert_array_equal(recording.imu.gyro_rad_s, samples.gyro_rad_s[rows])
    np.testing.assert_array_equal(recording.imu.accel_m_s2, samples.accel_m_s2[rows])
    assert len(recording.imu) == 60 and recording.ground_truth is not None


@pytest.mark.slow
def test_measured_paths_fit_into_their_worlds(data_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found: list[Any] = []
    monkeypatch.setattr("dronevio.recording.recorder.record_refly", lambda flown, *_, **__: found.append(flown))
    flights, left_out = measured_flights(["loops"])
    assert [flight.name for flight in flights] == list(MEASURED) and left_out == ""
    for flight in flights:
        flight.record(data_folder)
    assert [len(flown.schedule) for flown in found] == [1601, 1600, 2001]
    assert all(flown.real_imu for flown in found)
