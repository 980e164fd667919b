"""Processor time of visual SLAM beside that of its odometry, and frames that wait for the map, as a Markdown table.

Odometry and visual SLAM are run in turn, since the speed of a machine changes with time, and the differences are those
of the same turn: their median, and in brackets the smallest and the largest one. The processor time of the main process
is that of all of its threads; the worker process has a column of its own. An answer of the map is late if a frame has
to wait for it: with frames as fast as they are processed, and with frames at their times, as in flight. The machine
should do nothing else::

    .venv/bin/dronevio fly --scenario forest-laps --seed 3 --rig euroc-stereo --out recordings/forest
    OMP_NUM_THREADS=1 .venv/bin/python benchmarks/map_cost.py recordings/forest
"""

import statistics
import time
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from measuring import odometry, print_as_made

from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.estimator.slam.worker.map_builder import MapCost
from dronevio.estimators.driver import estimate_recording
from dronevio.eval.run import EstimatorRun
from dronevio.models.imu import ImuSamples, Times
from dronevio.models.protocols import Recording
from dronevio.models.recordings.open import open_recording
from dronevio.models.state import CameraFrame, Estimate


@dataclass(frozen=True)
class MapCostCommand:
    """Measure the cost of the map."""

    recording: Annotated[Path, tyro.conf.Positional]
    """Recording of the flight that both estimators run on."""
    cameras: tuple[int, ...] = (1, 2)
    """Numbers of cameras."""
    turns: int = 3
    """How often odometry and visual SLAM are run."""


@dataclass(frozen=True)
class Turn:
    """One run of the odometry and one of visual SLAM."""

    odometry: EstimatorRun
    """The run of the odometry."""
    slam: EstimatorRun
    """The run of visual SLAM."""
    map: MapCost
    """Cost of the map in the run of visual SLAM."""

    @property
    def mean_ms(self) -> float:
        """Mean processor time that visual SLAM adds to a frame in the main process [ms]."""
        return float(self.slam.cpu_ms.mean() - self.odometry.cpu_ms.mean())

    @property
    def p99_ms(self) -> float:
        """Difference of the 99th percentiles of the processor time of a frame in the main process [ms]."""
        return float(np.percentile(self.slam.cpu_ms, 99) - np.percentile(self.odometry.cpu_ms, 99))


class Pace:
    """Waits after each frame until it is time for the next one; a `RunObserver`."""

    def __init__(
        self, t_ns: Times, clock_s: Callable[[], float] = time.perf_counter, sleep: Callable[[float], None] = time.sleep
    ) -> None:
        """Take the time stamps (M,) of the frames [ns], a clock [s], and what waits for a number of seconds."""
        self._next_s = iter(((t_ns[1:] - t_ns[0]) * 1e-9).tolist())
        self._clock_s, self._sleep = clock_s, sleep
        self._begin_s: float | None = None

    def imu(self, samples: ImuSamples) -> None:
        """Do nothing: IMU samples come with the frame after them."""

    def frame(self, frame: CameraFrame, estimate: Estimate, cpu_ms: float) -> None:
        """Wait until it is time for the next frame; the first one, which starts the worker, begins the clock."""
        if self._begin_s is None:
            self._begin_s = self._clock_s()
        wait_s = self._begin_s + next(self._next_s, 0.0) - self._clock_s()
        if wait_s > 0.0:
            self._sleep(wait_s)


def turn_of(recording: Recording) -> Turn:
    """Return a turn: a run of the odometry and one of visual SLAM."""
    alone = odometry(recording)
    with closing(VisualSlam(recording.rig)) as slam:
        return Turn(alone, estimate_recording(recording, slam), slam.map_cost)


def paced_cost(recording: Recording) -> MapCost:
    """Return the cost of the map with frames at their times."""
    with closing(VisualSlam(recording.rig)) as slam:
        estimate_recording(recording, slam, observers=(Pace(recording.frame_times_ns),))
        return slam.map_cost


def row_of(cameras: int, turns: Sequence[Turn], paced: MapCost) -> dict[str, str]:
    """Return the row of a number of cameras."""
    speed = statistics.median(float(np.ptp(turn.slam.t_ns)) * 1e-6 / turn.slam.wall_ms.sum() for turn in turns)
    late = round(statistics.median(turn.map.waits for turn in turns))
    return {
        "cameras": str(cameras),
        "odometry [ms]": f"{statistics.median(turn.odometry.cpu_ms.mean() for turn in turns):.1f}",
        "added, mean [ms]": _spread([turn.mean_ms for turn in turns]),
        "added, 99 % [ms]": _spread([turn.p99_ms for turn in turns]),
        "worker [ms]": f"{statistics.median(turn.map.worker_cpu_ms_per_frame for turn in turns):.1f}",
        "answers": str(paced.results),
        "late, at full speed": f"{late}, at {speed:.1f} times the rate",
        "late, in flight": str(paced.waits),
    }


def _spread(values: Sequence[float]) -> str:
    """Return median, smallest and largest value as text."""
    return f"{statistics.median(values):.1f} ({min(values):.1f}, {max(values):.1f})"


def main(command: MapCostCommand) -> None:
    """Print a row for each number of cameras.

    Raises:
        InputError: The recording cannot be read.
    """
    recordings = ((cameras, open_recording(command.recording, cameras)) for cameras in command.cameras)
    print_as_made(
        row_of(cameras, [turn_of(recording) for _ in range(command.turns)], paced_cost(recording))
        for cameras, recording in recordings
    )


if __name__ == "__main__":
    main(tyro.cli(MapCostCommand, description=__doc__))
