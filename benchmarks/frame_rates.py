"""Accuracy and start of the odometry at any frame rate, as two tables.

``similar`` plays a real flight at other rates as an exact similarity (``similarity.py``): started at five places in
motion, with and without jitter of the time stamps. ``worlds`` renders one flight in each world at the stamps of 60 Hz
and of 50 Hz, keeps it in a folder, and decimates it. The ATE of one flight of some seconds varies by half with the
start, at any rate; with several starts or seeds, their RMS is compared. Each table ends with its figures
beside the bounds, and the script fails if one is not met::

    python benchmarks/frame_rates.py similar MH_01_real --cameras 1
    python benchmarks/frame_rates.py worlds /tmp/frame-rates --worlds room hall
    python benchmarks/frame_rates.py worlds /tmp/frame-rates --worlds low-texture --seeds 0 1 --starts-s 0 0.8
"""

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import tyro
from measuring import first_pose_s, frames_of, odometry
from similarity import gyro_bias_of, jittered, part_of, similar

from dronevio.cli.terminal import print_table
from dronevio.estimator.config import VioConfig
from dronevio.eval.metrics.scores import score_trajectory
from dronevio.models.protocols import Recording
from dronevio.models.recordings.euroc import INCOMPLETE, write_euroc
from dronevio.models.recordings.open import open_recording
from dronevio.models.state import Health
from dronevio.sim.cameras.schedule import FrameSchedule, schedule_frames
from dronevio.sim.flight import fly
from dronevio.sim.rendering.render import render_frames
from dronevio.sim.rendering.render_job import RenderJob
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import scenario_named
from dronevio.sim.world import WORLDS

RATE_HZ = 20.0
TICK_HZ = 300
"""Rate of which the rates of rendered frames are divisors [Hz]."""
RENDERED_HZ = (60, 50)
LIMITS_M = {1: 0.008, 2: 0.006}
"""Largest ATE of a copy that takes as long as the flight, by the number of cameras [m]."""
MAX_LATER_S, MAX_RATIO = 0.3, 1.3
"""Largest delay of the first pose, and ratio of the ATE, to those at 20 Hz."""


@dataclass(frozen=True)
class SimilarCommand:
    """Play a recording at other frame rates."""

    recording: tyro.conf.Positional[Path]
    """Recording with ground truth, in motion from the beginning, at 20 Hz."""
    cameras: tuple[int, ...] = (1, 2)
    """Numbers of cameras."""
    rates_hz: tuple[float, ...] = (10.0, 12.5, 15.0, 20.0, 24.0, 25.0, 29.97, 30.0)
    """Frame rates [Hz]."""
    jitter_hz: tuple[float, ...] = (25.0,)
    """Frame rates at which the time stamps also jitter [Hz]."""
    jitter_s: float = 1e-4
    """Standard deviation of that jitter [s]."""
    starts_s: tuple[float, ...] = (0.0, 1.2, 2.4, 3.6, 4.8)
    """Times in the recording at which the copies begin [s]."""


@dataclass(frozen=True)
class WorldsCommand:
    """Render flights and decimate their frames."""

    folder: tyro.conf.Positional[Path]
    """Folder of the recordings; those that are complete are used again."""
    worlds: tuple[str, ...] = tuple(WORLDS)
    """Names of the worlds."""
    rates_hz: tuple[int, ...] = (60, 50, 30, 20, 15, 12, 10)
    """Frame rates, divisors of 60 or 50, with 20 among them [Hz]."""
    seeds: tuple[int, ...] = (0,)
    """Seeds of the flights and of their worlds."""
    starts_s: tuple[float, ...] = (0.0,)
    """Times in the flights at which the recordings begin [s]; the drone takes off at 2 s."""
    duration_s: float = 12.0
    """Duration of the recordings [s]."""


@dataclass(frozen=True)
class Outcome:
    """What the odometry makes of a recording."""

    first_s: float
    """Time of the first pose after the first frame; infinite without any [s]."""
    ate_m: float
    """Absolute trajectory error after alignment of position and yaw; infinite without poses [m]."""
    not_tracking: int
    """Number of frames with a pose without the health "tracking", and of frames at which the odometry was lost."""

    def text(self, ate_per_m: float = 1.0) -> str:
        """Return time and error, the latter as a multiple of a length [m], and frames that are not tracked, if any."""
        if np.isinf(self.first_s):
            return "no pose"
        untracked = f" ({self.not_tracking})" if self.not_tracking else ""
        return f"{self.first_s:.2f} s {1e3 * self.ate_m / ate_per_m:.1f} mm{untracked}"


def outcome_of(recording: Recording) -> Outcome:
    """Estimate a recording that has ground truth."""
    run, truth = odometry(recording), recording.ground_truth
    if truth is None or len(run.trajectory) < 3:
        return Outcome(np.inf, np.inf, 0)
    scores = score_trajectory(truth, run.trajectory, recording.frame_times_ns).scores
    return Outcome(first_pose_s(run), scores.ate_m.rmse, frames_of(run, Health.INERTIAL_ONLY, Health.LOST))


def show_similar(command: SimilarCommand) -> int:
    """Print a table for each number of cameras; return 1 if a bound is not met."""
    failures = 0
    for count in command.cameras:
        recording = open_recording(command.recording, count)
        bias, limit_m, dynamic = gyro_bias_of(recording), LIMITS_M[min(count, 2)], VioConfig().initialization.dynamic
        window_s = dynamic.window_s if count == 1 else dynamic.stereo_window_s
        cases = [(rate_hz, 0.0) for rate_hz in command.rates_hz]
        cases += [(rate_hz, command.jitter_s) for rate_hz in command.jitter_hz]
        rows, starts, errors = [], [], []
        for rate_hz, jitter_s in cases:
            s, outcomes = RATE_HZ / rate_hz, []
            for start_s in command.starts_s:
                frames = np.arange(round(start_s * RATE_HZ), len(recording.frame_times_ns))
                played = jittered(similar(part_of(recording, frames), s, bias), jitter_s)
                outcomes.append(outcome_of(played))
            starts += [each.first_s <= 1.5 * window_s + 2.0 / rate_hz for each in outcomes]
            errors += [each.ate_m / s**2 for each in outcomes]
            name = f"{rate_hz:g} Hz" + (f", {1e3 * jitter_s:g} ms of jitter" if jitter_s else "")
            rows.append((name, *(each.text(s**2) for each in outcomes)))
            print(*rows[-1], sep=" | ", file=sys.stderr, flush=True)
        title = f"{recording.name}, {count} camera{'s' if count > 1 else ''}: first pose, and ATE / s²"
        print_table(title, ("", *(f"from {start_s:g} s" for start_s in command.starts_s)), rows)
        in_time, largest_m = float(np.mean(starts)), max(errors)
        print(
            f"first pose within 1.5 × {window_s:g} s + 2 frames: {in_time:.1%} of {len(starts)} (95 % expected);"
            f" largest ATE / s²: {1e3 * largest_m:.1f} mm (at most {1e3 * limit_m:g})\n"
        )
        failures += in_time < 0.95 or largest_m > limit_m
    return int(failures > 0)


def scenario_of(world: str, seed: int) -> Scenario:
    """Return the scenario of a flight of medium difficulty through a world."""
    name = world if world in ("low-texture", "repetitive", "dark", "mirror", "moving") else f"{world}-medium"
    return scenario_named(name, seed)


def rendered(world: str, seed: int, folder: Path, duration_s: float) -> Recording:
    """Return a flight through a world with the frames of all rates, and render it if it is not in its folder."""
    mav0 = folder / "mav0"
    if not (mav0 / "imu0" / "data.csv").exists() or (mav0 / INCOMPLETE).exists():
        flight = fly(scenario_of(world, seed))
        schedule = schedule_of(flight.scenario, duration_s)
        end = int(np.searchsorted(flight.truth.t_ns, schedule.exposed_ns[-1] + 100_000_000))
        truth, scenario = flight.truth[slice(0, end)], flight.scenario
        job = RenderJob(world, scenario.seed, flight.true_rig, flight.truth, schedule, scenario.imaging)
        write_euroc(folder, scenario.rig, flight.imu[:end], truth, schedule.stamps_ns)
        render_frames(job, mav0, workers=1)
    return open_recording(folder)


def schedule_of(scenario: Scenario, duration_s: float) -> FrameSchedule:
    """Return the frames of all rates that are rendered, but the first, before which there is no exposure."""
    stamps_ns = [np.rint(np.arange(1, duration_s * rate + 0.5) * 1e9 / rate).astype(np.int64) for rate in RENDERED_HZ]
    merged_ns = np.unique(np.concatenate(stamps_ns))
    return schedule_frames(merged_ns[1:], scenario.generator("frames"), scenario.rig.time_offset_s)


def decimated(recording: Recording, rate_hz: int, start_s: float) -> Recording:
    """Return the frames of a recording at one of its rates [Hz], from a time on [s]."""
    ticks: npt.NDArray[np.int64] = np.rint(recording.frame_times_ns * (TICK_HZ * 1e-9)).astype(np.int64)
    kept = (ticks % (TICK_HZ // rate_hz) == 0) & (recording.frame_times_ns >= start_s * 1e9)
    return part_of(recording, np.flatnonzero(kept), float(rate_hz))


def show_worlds(command: WorldsCommand) -> int:
    """Print a table of all flights, and the RMS over those of each world; return 1 if a bound is not met."""
    rows, summaries, late, pooled, single = [], [], [], [], []
    for world in command.worlds:
        ates_m = []
        for seed in command.seeds:
            recording = rendered(world, seed, command.folder / f"{world}-{seed}", command.duration_s)
            for start_s in command.starts_s:
                outcomes = {rate: outcome_of(decimated(recording, rate, start_s)) for rate in command.rates_hz}
                late += [each.first_s - outcomes[20].first_s for each in outcomes.values()]
                ates_m.append([each.ate_m for each in outcomes.values()])
                rows.append((f"{world}, seed {seed}, from {start_s:g} s", *(each.text() for each in outcomes.values())))
                print(*rows[-1], sep=" | ", file=sys.stderr, flush=True)
        at_20_hz, errors_m = command.rates_hz.index(20), np.array(ates_m)
        rms_m = np.sqrt((errors_m**2).mean(axis=0))
        pooled += (rms_m / rms_m[at_20_hz]).tolist()
        single += (errors_m / errors_m[:, at_20_hz, None]).ravel().tolist()
        summaries.append((world, *(f"{1e3 * each:.1f} mm, {each / rms_m[at_20_hz]:.2f}" for each in rms_m)))
    titles = tuple(f"{rate} Hz" for rate in command.rates_hz)
    print_table("First pose and ATE", ("", *titles), rows)
    print_table("RMS of the ATE, and its ratio to that at 20 Hz", ("", *titles), summaries)
    print(summary(late, pooled, single))
    return int(max(late) > MAX_LATER_S or max(pooled) > MAX_RATIO)


def summary(delays_s: Sequence[float], pooled: Sequence[float], single: Sequence[float]) -> str:
    """Return the largest delay of the first pose [s] and ratio of the ATE to those at 20 Hz, beside the bounds."""
    return (
        f"first pose after that at 20 Hz: at most {max(delays_s):.2f} s (at most {MAX_LATER_S:g});"
        f" ATE to that at 20 Hz: at most {max(pooled):.2f} (at most {MAX_RATIO:g}), of single flights {max(single):.2f}"
    )


Command = (
    Annotated[SimilarCommand, tyro.conf.subcommand("similar")]
    | Annotated[WorldsCommand, tyro.conf.subcommand("worlds")]
)


def main(command: SimilarCommand | WorldsCommand) -> int:
    """Print the table of a command."""
    return show_similar(command) if isinstance(command, SimilarCommand) else show_worlds(command)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Command, description=__doc__)))
