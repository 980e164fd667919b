"""Exchanged images: the vehicle is somewhere else from one frame to the next, as when it is carried away."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from dronevio.estimator.initialization.dynamic import DynamicInitializationConfig
from dronevio.models.arrays import Array
from dronevio.models.state import CameraFrame, Estimate, Health
from tests.estimator.conftest import START_NS, Kinematics, Motion, SyntheticFrontEnd

if TYPE_CHECKING:
    from dronevio.estimator.types import Observations
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

CARRIED_S, FRAMES_PER_S = 12.0, 20
"""Time of the first frame in the other place [s], and rate of the frames [Hz]."""


@dataclass(frozen=True)
class CarriedMotion(Motion):
    """A motion of which some seconds are left out."""

    skipped_s: float = 0.0

    def at(self, t_s: Array) -> Kinematics:
        return super().at(t_s + self.skipped_s * (t_s >= CARRIED_S - 1e-6))


class CarriedFrontEnd(SyntheticFrontEnd):
    """Tracks no feature from one place to the other."""

    def track(self, frame: CameraFrame, *motion: Any, **options: Any) -> "Observations":
        if frame.t_ns == START_NS + round(CARRIED_S * 1e9):
            self._ids[:] = -1
        return super().track(frame, *motion, **options)


def carried(make_flight: MakeFlight, seed: int, skipped_s: float) -> tuple["SyntheticFlight", list[Estimate]]:
    """Return a flight that leaves out some seconds at `CARRIED_S`, and its estimates."""
    flight = make_flight(seed, duration_s=CARRIED_S + 4.0)
    m = flight.motion
    motion = CarriedMotion(m.rest_s, phases=m.phases, R_vehicle_imu=m.R_vehicle_imu, skipped_s=skipped_s)
    flight = replace(flight, motion=motion)
    return flight, flight.run(CarriedFrontEnd(flight))


def time_after_s(estimates: list[Estimate], event: str) -> float:
    """Return the time of the only estimate with an event after the vehicle was carried away [s]."""
    frames = [k for k, e in enumerate(estimates) if any(text.startswith(event) for text in e.events)]
    assert len(frames) == 1
    return frames[0] / FRAMES_PER_S - CARRIED_S


@pytest.mark.parametrize("seed", range(3))
def test_carried_vehicle_is_lost_and_starts_again_at_once(make_flight: MakeFlight, seed: int) -> None:
    """The window of the initialization begins with the first image of the other place, not with the loss."""
    flight, estimates = carried(make_flight, seed, skipped_s=7.0)
    assert 0.0 < time_after_s(estimates, "lost: no feature connects the images") < 0.7
    assert time_after_s(estimates, "recovered") == pytest.approx(DynamicInitializationConfig().window_s, abs=0.26)
    last, truth = estimates[-1].state, flight.state_at(estimates[-1].t_ns)
    assert last is not None
    velocity, true_velocity = (s.T_world_imu[:3, :3].T @ s.velocity_m_s for s in (last, truth))
    assert np.linalg.norm(velocity - true_velocity) < 0.03
    # The poses after the recovery are in another odometry frame than those before.
    track = [estimate.track for estimate in estimates]
    assert track == sorted(track) and track[0] == track[round((CARRIED_S - 0.5) * FRAMES_PER_S)] == 0 < track[-1]
    lost = next(k for k, e in enumerate(estimates) if any(text.startswith("lost") for text in e.events))
    assert track[lost] == track[-1]


def test_exchanged_features_in_the_same_place_are_no_loss(make_flight: MakeFlight) -> None:
    _, estimates = carried(make_flight, 0, skipped_s=0.0)
    assert all(e.state is not None for e in estimates[2 * FRAMES_PER_S :]) and estimates[-1].health is Health.TRACKING
    assert estimates[-1].track == 1  # no image has shown that it is the same place
