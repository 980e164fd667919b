"""The driver pushes a recording into an estimator and keeps what a run needs."""

from types import SimpleNamespace

import numpy as np

from dronevio.estimators.driver import estimate_recording
from dronevio.models.imu import ImuSamples
from dronevio.models.map_correction import MapCorrection
from dronevio.models.rig import euroc_rig
from dronevio.models.state import CameraFrame, Estimate, Health, NavState


class Corrected:
    """An estimator whose estimates have the correction by a map."""

    def add_imu(self, samples: ImuSamples) -> None:
        """Do nothing."""

    def add_frame(self, frame: CameraFrame) -> Estimate:
        """Return an estimate without a state."""
        return Estimate(frame.t_ns, Health.INITIALIZING, None, map_correction=MapCorrection.empty())

    def state_at(self, t_ns: int) -> NavState | None:
        """Return nothing."""
        return None


def test_observers_receive_the_correction_that_a_run_does_not_keep() -> None:
    """Corrections have all keyframes: a run of thousands of frames would keep a copy for each that changes them."""
    image = np.zeros((480, 752), np.uint8)
    recording = SimpleNamespace(
        rig=euroc_rig(),
        imu=ImuSamples.empty(),
        frame_times_ns=np.array([0, 50_000_000]),
        frame=lambda index: CameraFrame(50_000_000 * index, (image,)),
    )
    received: list[Estimate] = []
    observer = SimpleNamespace(
        imu=lambda samples: None, frame=lambda frame, estimate, cpu_ms: received.append(estimate)
    )
    run = estimate_recording(recording, Corrected(), observers=(observer,))
    assert len(received) == 2 and all(estimate.map_correction is not None for estimate in received)
    assert len(run.estimates) == 2 and all(estimate.map_correction is None for estimate in run.estimates)
