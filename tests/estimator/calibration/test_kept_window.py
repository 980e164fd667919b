"""The odometry after a correction of the calibration in motion."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

from dronevio.estimator.backend.keyframe_estimate import KeyframeEstimate
from dronevio.estimator.keyframe_observer import OdometryKeyframe

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]


class WindowLengths:
    """Records how many keyframes the window has at each keyframe."""

    def __init__(self) -> None:
        self.of_times: dict[int, int] = {}
        """Lengths of the window by the times of the keyframes [ns]."""

    def added(self, keyframe: OdometryKeyframe) -> None:
        """Record the length of the window."""
        self.of_times[keyframe.t_ns] = len(keyframe.window_times_ns)

    def marginalized(self, estimate: KeyframeEstimate) -> None:
        """Ignore the estimate of a keyframe that leaves the window."""

    def lost(self) -> None:
        """Fail, because the flight is never lost."""
        raise AssertionError("the estimate was lost")


def test_a_correction_in_motion_keeps_the_window(make_flight: MakeFlight) -> None:
    """After the correction of a time offset of 6 ms, the next keyframe is added to the window of those before."""
    flight = make_flight(0, rest_s=-5.0, duration_s=10.0)
    front_end = replace(flight, rig=replace(flight.rig, time_offset_s=0.006)).front_end()
    lengths = WindowLengths()
    estimates = flight.run(front_end, observer=lengths)
    corrected_ns = [e.t_ns for e in estimates if any("calibration corrected: time offset" in x for x in e.events)]
    assert corrected_ns
    following = min(t_ns for t_ns in lengths.of_times if t_ns > corrected_ns[0])
    assert lengths.of_times[following] > 5
