"""What the map gains: the odometry, the path corrected online and the final one, as Markdown tables.

Visual SLAM runs on every recording with every number of cameras, start and alteration of the IMU. A flight is one line
of a JSON-lines file, which is written as soon as it has been estimated; flights that are in the file already are not
estimated again, so that an interrupted measurement goes on. ATEs are those after alignment of yaw and position; "scale
freed" are those after a factor of the path as well, and "rotation aligned" those after alignment of the whole
rotation, which inclines the vertical of the final path by "tilt". A flight without a pose, or that ends with an error,
has an infinite error and keeps no bound::

    .venv/bin/dronevio fly --scenario room-square --seed 2 --rig euroc-stereo --out recordings/square
    .venv/bin/python benchmarks/map_gains.py recordings/square --cameras 1 2 --starts-s 0 10 --alterations none bias
"""

import math
import sys
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from faulty_imus import Fault, of_imu, with_values
from map_gain_tables import HEADINGS, Flight, PathScores, cells, summary
from measuring import ChangedRecording, keep, line, section_of, table, with_truth

from dronevio.api import estimate
from dronevio.benchmark.jobs import versions
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.eval.map_results import MapResults, map_results
from dronevio.eval.metrics.scores import score_trajectory
from dronevio.eval.provenance import machine_here
from dronevio.eval.run import EstimatorRun
from dronevio.models.errors import ConfigError, DronevioError
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.recording.excerpts import excerpt_of

FACTOR = 3.0
"""Noise density and bias of an altered IMU, relative to those that are stated."""


def with_noise(recording: ChangedRecording, rng: np.random.Generator) -> ChangedRecording:
    """Return a recording with white noise added: with that of the stated density, it has `FACTOR` times the density."""
    imu, samples = recording.rig.imu, recording.imu
    per_sample = math.sqrt((FACTOR**2 - 1.0) * imu.rate_hz)
    gyro = rng.normal(0.0, per_sample * imu.gyro_noise_density, samples.gyro_rad_s.shape)
    accel = rng.normal(0.0, per_sample * imu.accel_noise_density, samples.accel_m_s2.shape)
    return replace(recording, imu=with_values(samples, samples.gyro_rad_s + gyro, samples.accel_m_s2 + accel))


def with_bias(recording: ChangedRecording, rng: np.random.Generator) -> ChangedRecording:
    """Return a recording with constant biases added: `FACTOR` turn-on standard deviations, of random sign, per axis."""
    imu, samples = recording.rig.imu, recording.imu
    gyro, accel = (
        FACTOR * rng.choice([-1.0, 1.0], (2, 3)) * [[imu.gyro_turn_on_bias_rad_s], [imu.accel_turn_on_bias_m_s2]]
    )
    return replace(recording, imu=with_values(samples, samples.gyro_rad_s + gyro, samples.accel_m_s2 + accel))


ALTERATIONS: Mapping[str, Fault] = {
    "none": lambda recording, _: recording,
    "noise": with_noise,
    "bias": with_bias,
    "scale": of_imu(lambda samples, _: with_values(samples, samples.gyro_rad_s, 1.01 * samples.accel_m_s2)),
}
"""Alterations of the IMU by name."""


@dataclass(frozen=True)
class MapGainsCommand:
    """Measure what the map gains on flights with ground truth."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings with ground truth."""
    out: Path
    """JSON-lines file of the flights, which is continued if it exists."""
    cameras: tuple[int, ...] = (1, 2)
    """Numbers of cameras that the estimator uses."""
    starts_s: tuple[float, ...] = (0.0,)
    """Times after the first frame at which the flights begin [s]."""
    duration_s: float | None = None
    """Duration of each flight [s]; None to the end of the recording."""
    alterations: tuple[str, ...] = ("none",)
    """Names of the alterations: none, noise, bias, scale."""


def window_of(recording: Recording, start_s: float, duration_s: float | None) -> ChangedRecording:
    """Return a part of a recording, with its ground truth.

    Raises:
        ConfigError: The recording has no ground truth, or is shorter than the start.
    """
    begun, truth = with_truth(excerpt_of(recording, start_s))
    times_ns = begun.frame_times_ns
    if duration_s is None:
        return ChangedRecording.of(begun)
    frames = int(np.searchsorted(times_ns, times_ns[0] + round(1e9 * duration_s), side="right"))
    return replace(section_of(begun, frames), ground_truth=truth)


def flight_of(asked: Flight, window: ChangedRecording) -> Flight:
    """Return a flight with its results.

    Args:
        asked: The flight without them.
        window: Its part of the recording, without the alteration.
    """
    seed = zlib.crc32("/".join(map(str, asked.key[:1])).encode())  # the same errors with one camera and two
    recording = ALTERATIONS[asked.alteration](window, np.random.default_rng(seed))
    slam = VisualSlam(recording.rig)
    try:
        run = estimate(recording, slam)
        return with_results(asked, run, map_results(run, recording), recording)
    except DronevioError as error:
        return replace(asked, outcome=f"failed: {error}")
    except Exception as error:  # a flight that ends so is one that counts
        return replace(asked, outcome=f"DEFECT: {type(error).__name__}: {error}")
    finally:
        slam.close()


def with_results(asked: Flight, run: EstimatorRun, found: MapResults | None, recording: Recording) -> Flight:
    """Return a flight with the results of a run."""
    if not len(run.trajectory):
        return replace(asked, outcome="failed: no pose")
    assert recording.ground_truth is not None
    odometry = score_trajectory(recording.ground_truth, run.trajectory, recording.frame_times_ns)
    flown = replace(asked, odometry=PathScores.of(odometry), coverage_percent=odometry.scores.coverage_percent)
    if found is None:
        return replace(flown, outcome="failed: no map")
    assert found.scored_online is not None and found.scored_final is not None
    rejected = int(found.map.rejected.sum())
    return replace(
        flown,
        outcome=found.map.adjustment,
        loops=len(found.map.loops) - rejected,
        rejected=rejected,
        online=PathScores.of(found.scored_online),
        final=PathScores.of(found.scored_final),
    )


def main(command: MapGainsCommand) -> None:
    """Estimate the flights that are not in the file, and print the tables of all that were asked for.

    Raises:
        ConfigError: A recording has no ground truth or is too short, an alteration is unknown, or two recordings have
            the same name.
        InputError: A recording cannot be read.
    """
    names = [path.resolve().name for path in command.recordings]
    if len(set(names)) < len(names):
        raise ConfigError(f"recordings named {', '.join(names)}; expected different names")
    if unknown := [name for name in command.alterations if name not in ALTERATIONS]:
        raise ConfigError(f"unknown alteration {unknown[0]!r}; expected one of {', '.join(ALTERATIONS)}")
    made_by = ", ".join((*machine_here().values(), versions()))
    lines = command.out.read_text(encoding="utf-8").splitlines() if command.out.exists() else ()
    known = {flight.key: flight for flight in map(Flight.from_json, lines)}
    flights = []
    for path, name in zip(command.recordings, names, strict=True):
        for cameras, start_s, alteration in (
            (cameras, start_s, alteration)
            for cameras in command.cameras
            for start_s in command.starts_s
            for alteration in command.alterations
        ):
            asked = Flight(name, cameras, start_s, command.duration_s, alteration, "", made_by=made_by)
            if asked.key not in known:
                flight = flight_of(asked, window_of(open_recording(path, cameras), start_s, command.duration_s))
                keep(command.out, flight)
                known[asked.key] = flight
                print(line(cells(flight)), file=sys.stderr, flush=True)
            flights.append(known[asked.key])
    print(table(HEADINGS, map(cells, flights)))
    print(f"\n{summary(flights)}\n")
    for made_by in dict.fromkeys(flight.made_by for flight in flights):
        print(f"Measured on {made_by}.")


if __name__ == "__main__":
    main(tyro.cli(MapGainsCommand, description=__doc__))
