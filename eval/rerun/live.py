"""A flight in a recording while it goes on: a second at a time, with what is known by then.

Nobody knows the best alignment before the end, so the estimate is tied to the truth at its first pose.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import reduce

import numpy as np

from dronevio.eval import colours
from dronevio.eval.rerun.blueprint import Shown, flight_blueprint
from dronevio.eval.rerun.estimate import EstimateLog, tied_to
from dronevio.eval.rerun.images import JpegLog
from dronevio.eval.rerun.log import RerunLog, first_ns, places_of
from dronevio.eval.rerun.sink import Sink
from dronevio.eval.rerun.surroundings import NOTHING_KNOWN, Surroundings
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import Recording
from dronevio.models.state import CameraFrame, Estimate, Trajectory

CHUNK_S = 1.0
"""How much of a flight is handed over at once [s]: ten calls to rerun a second of flight instead of thousands."""


class LiveLog:
    """Hears what a running estimator is given and what it answers, and logs both."""

    def __init__(
        self, log: RerunLog, estimate: EstimateLog, truth: Trajectory | None, chunk_s: float = CHUNK_S
    ) -> None:
        """Say where measurements and answers go.

        Args:
            log: Takes the measurements.
            estimate: Takes the answers.
            truth: The true motion, where it is known.
            chunk_s: How much of the flight is handed over at once [s].
        """
        self._log = log
        self._estimate = estimate
        self._truth = truth
        self._chunk_ns = round(chunk_s * 1e9)
        self._imu: list[ImuSamples] = []
        self._answers: list[Estimate] = []
        self._cpu_ms: list[float] = []

    def imu(self, samples: ImuSamples) -> None:
        """Hear of IMU samples."""
        self._imu.append(samples)

    def frame(self, frame: CameraFrame, answer: Estimate, cpu_ms: float) -> None:
        """Hear of a frame, what the estimator said, and the processor time that it took to say it [ms]."""
        self._log.frame(frame)
        self._answers.append(answer)
        self._cpu_ms.append(cpu_ms)
        if answer.t_ns - self._answers[0].t_ns >= self._chunk_ns:
            self.flush()

    def flush(self) -> None:
        """Hand over what has been heard."""
        if self._imu:
            self._log.imu(reduce(ImuSamples.extended, self._imu))
        shown = self._estimate.answers(self._answers, np.array(self._cpu_ms))
        if self._truth is None:
            self._log.rig_poses(shown)  # the images are seen from somewhere
        else:
            self._estimate.errors_so_far(self._truth, shown)
        self._imu, self._answers, self._cpu_ms = [], [], []


@contextmanager
def watched(
    url: str, recording: Recording, surroundings: Surroundings = NOTHING_KNOWN, name: str = "estimate"
) -> Iterator[LiveLog]:
    """Show a flight in a viewer while an estimator works through it.

    Args:
        url: Where the viewer listens: ``rerun+http://127.0.0.1:9876/proxy``.
        recording: What is being estimated.
        surroundings: What stands and moves around.
        name: What the estimator is called.
    """
    truth = recording.ground_truth
    shown = Shown((name,), len(recording.rig.cameras), truth is not None)
    places = places_of(surroundings, [] if truth is None else [truth])
    blueprint = flight_blueprint(shown, places)
    batch = max(1, round(CHUNK_S * recording.rig.cameras[0].rate_hz))
    with (
        Sink.to_viewer(url, recording.name, blueprint, first_ns(recording)) as sink,
        RerunLog(sink, recording.rig, lambda sink, entity, _: JpegLog(sink, entity, batch), places) as log,
    ):
        log.surroundings(surroundings, recording.frame_times_ns)
        if truth is not None:
            log.truth(truth, recording.frame_times_ns)
        live = LiveLog(log, log.estimator(name, colours.ESTIMATE, tied_to(truth)), truth)
        try:
            yield live
        finally:
            live.flush()
