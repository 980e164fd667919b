"""Causality with gaps of the IMU: estimates do not depend on samples that a vehicle would not have received yet."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from dronevio.estimator.odometry import VisualInertialOdometry
from dronevio.models.imu import ImuSamples
from dronevio.models.protocols import MAX_WAIT_INTERVALS, exposure_delay_ns
from dronevio.models.rig import Rig
from dronevio.models.state import Estimate

if TYPE_CHECKING:
    from tests.estimator.conftest import SyntheticFlight

MakeFlight = Callable[..., "SyntheticFlight"]

GAP_S = (3.0, 3.6)
INTERVAL_NS = 5_000_000


def poses(estimates: list[Estimate]) -> list[bytes]:
    """Return the state and its covariance of each estimate as bytes."""
    states = [estimate.state for estimate in estimates]
    return [
        b"" if s is None or s.covariance is None else s.T_world_imu.tobytes() + s.velocity_m_s.tobytes()
        + s.covariance.tobytes() for s in states
    ]  # fmt: skip


def with_imu(flight: "SyntheticFlight", imu: ImuSamples) -> "SyntheticFlight":
    """Return a flight with other IMU samples."""
    other = replace(flight)
    other.__dict__["imu"] = imu
    return other


def without_samples(imu: ImuSamples, from_ns: int, to_ns: int) -> ImuSamples:
    """Return the samples that are not within an interval."""
    kept = (imu.t_ns <= from_ns) | (imu.t_ns >= to_ns)
    return ImuSamples(imu.t_ns[kept], imu.gyro_rad_s[kept], imu.accel_m_s2[kept], imu.sampling)


def altered_from(imu: ImuSamples, t_ns: int) -> ImuSamples:
    """Return the samples with other values from a time on."""
    late = (imu.t_ns >= t_ns)[:, None]
    return ImuSamples(imu.t_ns, imu.gyro_rad_s + 0.5 * late, imu.accel_m_s2 - 3.0 * late, imu.sampling)


def shaken_from(imu: ImuSamples, t_ns: int) -> ImuSamples:
    """Return the samples with strong vibration from a time on, and with a gyroscope that saturates at 0.6 rad/s."""
    rng, late = np.random.default_rng(0), (imu.t_ns >= t_ns)[:, None]
    gyro = imu.gyro_rad_s + late * rng.normal(0.0, 0.2, imu.gyro_rad_s.shape)
    accel = imu.accel_m_s2 + late * rng.normal(0.0, 4.0, imu.accel_m_s2.shape)
    return ImuSamples(imu.t_ns, gyro.clip(-0.6, 0.6), accel, imu.sampling)


def rig_with(rig: Rig, time_offset_s: float, readout_s: float) -> Rig:
    """Return a rig with a time offset and a rolling shutter."""
    cameras = tuple(replace(camera, readout_s=readout_s) for camera in rig.cameras)
    return replace(rig, cameras=cameras, time_offset_s=time_offset_s)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("time_offset_s", "readout_s", "sampling"),
    [
        (0.0, 0.0, "point"),
        (0.0, 0.0, "increment"),
        (0.012, 0.0, "point"),
        (-0.012, 0.0, "point"),
        (0.0, 0.02, "point"),
        (0.007, 0.02, "increment"),
    ],
)
def test_samples_after_a_gap_change_no_earlier_pose(
    make_flight: MakeFlight, time_offset_s: float, readout_s: float, sampling: str
) -> None:
    """The samples from the end of a gap on have other values: no frame differs that a vehicle answers before them."""
    flight = make_flight(seed=3, rest_s=0.9, duration_s=4.0, sampling=sampling)
    flight = replace(flight, rig=rig_with(flight.rig, time_offset_s, readout_s))
    start_ns = int(flight.frame_times_ns[0])
    gap_ns = [start_ns + round(t_s * 1e9) for t_s in GAP_S]
    gapped = without_samples(flight.imu, *gap_ns)
    end_ns = int(gapped.t_ns[gapped.t_ns >= gap_ns[1]][0])
    answered_ns = flight.frame_times_ns + exposure_delay_ns(flight.rig) + round(MAX_WAIT_INTERVALS * INTERVAL_NS)
    before = answered_ns < end_ns
    estimates = with_imu(flight, gapped).run()
    others = with_imu(flight, altered_from(gapped, end_ns)).run()
    assert sum(flight.frame_times_ns[before] > gap_ns[0]) >= 9  # frames within the gap
    assert all(e.state is not None for e, early in zip(estimates, before, strict=True) if early and e.t_ns > gap_ns[0])
    assert [p for p, early in zip(poses(estimates), before, strict=True) if early] == [
        p for p, early in zip(poses(others), before, strict=True) if early
    ]
    assert poses(estimates)[-1] != poses(others)[-1]


def run_ahead(flight: "SyntheticFlight", ahead_ns: int) -> list[Estimate]:
    """Return the estimates where each frame comes late, so that later samples of some time are already there."""
    vio, imu, sent = VisualInertialOdometry(flight.rig, front_end=flight.front_end()), flight.imu, 0
    estimates = []
    for index, t_ns in enumerate(flight.frame_times_ns):
        end = int(np.searchsorted(imu.t_ns, t_ns + ahead_ns, side="right"))
        vio.add_imu(imu[sent:end])
        sent = end
        estimates.append(vio.add_frame(flight.frame(index)))
    return estimates


@pytest.mark.parametrize("ahead_s", [0.03, 0.5, 100.0])
def test_the_latency_of_frames_changes_no_estimate(make_flight: MakeFlight, ahead_s: float) -> None:
    """A live system has samples later than the frame, a replay none: vibration and saturation begin with the frame."""
    flight = make_flight(seed=3, rest_s=0.9, duration_s=4.0)
    flight = with_imu(flight, shaken_from(flight.imu, int(flight.frame_times_ns[0]) + 2_500_000_000))
    replayed, live = flight.run(), run_ahead(flight, round(ahead_s * 1e9))
    assert poses(live) == poses(replayed)
    assert [estimate.events for estimate in live] == [estimate.events for estimate in replayed]
    assert replayed[-1].state is not None


def test_a_gap_at_the_end_is_bridged_by_the_last_sample(make_flight: MakeFlight) -> None:
    """An IMU that stops is no different from one that pauses, as long as it pauses."""
    flight = make_flight(seed=3, rest_s=0.9, duration_s=4.0)
    start_ns = int(flight.frame_times_ns[0])
    gap_ns = [start_ns + round(t_s * 1e9) for t_s in GAP_S]
    paused = with_imu(flight, without_samples(flight.imu, *gap_ns)).run()
    stopped = with_imu(flight, flight.imu.up_to(gap_ns[0])).run()
    frames = int(np.searchsorted(flight.frame_times_ns, gap_ns[1] - 10_000_000))
    assert poses(paused)[:frames] == poses(stopped)[:frames]
    assert any("no IMU for" in event for estimate in paused for event in estimate.events)
