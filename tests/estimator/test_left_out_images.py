"""Images that are left out because they show what is expected, on synthetic flights."""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace

import numpy as np
import pytest

from dronevio.estimator.backend.keyframes import KeyframeConfig
from dronevio.estimator.calibration.online import OnlineCalibration
from dronevio.estimator.config import VioConfig
from dronevio.estimator.frontend.rig import measures_depth
from dronevio.estimator.imu.buffer import Increments
from dronevio.estimator.monitoring.stamp_error import StampCorrection
from dronevio.estimator.types import Calibration
from dronevio.eval.metrics.alignment import align
from dronevio.models.arrays import Array
from dronevio.models.state import Estimate, Health, Trajectory
from tests.estimator.conftest import SyntheticFlight, VerifyingFrontEnd

MakeFlight = Callable[..., SyntheticFlight]
STATIONARY = 1.5
"""Time at which the motion begins [s]."""
CALM = {"position_rates": np.full((3, 2), 0.4), "angle_rates": np.full((3, 2), 0.4)}


@pytest.fixture(autouse=True)
def one_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the images of one camera, too: synthetic flights have no other."""
    monkeypatch.setattr("dronevio.estimator.pipeline.measures_depth", lambda rig: True)


def poses(estimates: list[Estimate]) -> Trajectory:
    """Return the states of the estimates that have one."""
    return Trajectory.from_states(e.state for e in estimates if e.state is not None)


def ate_m(flight: SyntheticFlight, estimated: Trajectory) -> float:
    """Return the absolute trajectory error, aligned in position and yaw [m]."""
    truth = flight.truth_at(estimated.t_ns)
    fit = align(truth.p_world_imu, estimated.p_world_imu, "yaw")
    return float(np.sqrt(np.mean(np.sum((truth.p_world_imu - fit.positions(estimated.p_world_imu)) ** 2, axis=1))))


@dataclass(frozen=True, eq=False)
class JumpingFlight(SyntheticFlight):
    """A flight whose landmarks jump aside at a time."""

    jump_ns: int = 0
    """The time [ns]."""

    def landmarks_at(self, t_ns: int) -> Array:
        return super().landmarks_at(t_ns) + [0.0, 0.2 * (t_ns >= self.jump_ns), 0.0]


def verified_frames(flight: SyntheticFlight, front_end: VerifyingFrontEnd) -> list[int]:
    """Return the indices of the frames of a flight that were verified instead of tracked."""
    return [int(row) for row in np.searchsorted(flight.frame_times_ns, front_end.verified_ns)]


def test_images_that_show_what_is_expected_are_left_out_at_no_cost(make_flight: MakeFlight) -> None:
    """The report is that of the last one that was tracked; the tracks are where they are expected."""
    flight = make_flight(1, rest_s=STATIONARY, duration_s=8.0, motion=CALM)
    every, front_end = flight.run(), VerifyingFrontEnd(flight)
    sparse = flight.run(front_end)
    missing = verified_frames(flight, front_end)
    assert len(missing) > 60
    after = {k + 1 for k in missing} - set(missing)
    assert set(np.searchsorted(flight.frame_times_ns, front_end.expected_ns).tolist()) == after
    assert not any("keyframe" in sparse[k].events for k in missing)
    assert sum("keyframe" in e.events for e in sparse) == sum("keyframe" in e.events for e in every)
    for k in missing:
        now, before, tracks = sparse[k].health_report, sparse[k - 1].health_report, sparse[k].tracks
        assert now is not None and before is not None and sparse[k].health is Health.TRACKING
        assert (now.landmarks, now.innovation_nis) == (before.landmarks, before.innovation_nis)
        assert now.position_sigma_m != before.position_sigma_m
        assert tracks is not None and len(tracks.ids) >= 20
    assert ate_m(flight, poses(sparse)) < 1.2 * ate_m(flight, poses(every))


def test_every_image_of_one_camera_is_tracked(make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dronevio.estimator.pipeline.measures_depth", measures_depth)
    flight = make_flight(1, rest_s=STATIONARY, duration_s=5.0, motion=CALM)
    front_end = VerifyingFrontEnd(flight)
    flight.run(front_end)
    assert not front_end.verified_ns


def test_every_image_is_tracked_if_it_is_a_setting(make_flight: MakeFlight) -> None:
    flight = make_flight(1, rest_s=STATIONARY, duration_s=5.0, motion=CALM)
    front_end = VerifyingFrontEnd(flight)
    flight.run(front_end, VioConfig(keyframe=KeyframeConfig(every_image=True)))
    assert not front_end.verified_ns


@pytest.mark.parametrize(("part", "quality"), [(StampCorrection, "is_irregular"), (Increments, "is_degraded")])
def test_every_image_is_tracked_where_the_prediction_is_poor(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch, part: type, quality: str
) -> None:
    """Irregular time stamps, and a saturated IMU or one with gaps, give no exact prediction."""
    flight = make_flight(1, rest_s=STATIONARY, duration_s=5.0, motion=CALM)
    front_end = VerifyingFrontEnd(flight)
    monkeypatch.setattr(part, quality, True)
    flight.run(front_end)
    assert not front_end.verified_ns


def test_every_image_is_tracked_where_cameras_determine_no_depth(
    make_flight: MakeFlight, monkeypatch: pytest.MonkeyPatch
) -> None:
    flight = make_flight(1, rest_s=STATIONARY, duration_s=5.0, motion=CALM)
    front_end = VerifyingFrontEnd(flight)
    monkeypatch.setattr(OnlineCalibration, "calibration", Calibration(flight.rig, without_depth=frozenset({0})))
    flight.run(front_end)
    assert not front_end.verified_ns


def test_images_that_show_something_else_are_tracked(make_flight: MakeFlight) -> None:
    """From a frame between keyframes on, the landmarks are 20 cm farther to the side."""
    flight = make_flight(1, rest_s=STATIONARY, duration_s=8.0, motion=CALM)
    front_end = VerifyingFrontEnd(flight)
    flight.run(front_end)
    missing = verified_frames(flight, front_end)
    first = next(k for k in missing if k > 120 and {k + 1, k + 2} <= set(missing))
    jump_ns = int(flight.frame_times_ns[first + 1])
    moving = JumpingFlight(**{f.name: getattr(flight, f.name) for f in fields(flight)}, jump_ns=jump_ns)
    front_end = VerifyingFrontEnd(moving)
    estimates = moving.run(front_end)
    assert not {first + 1, first + 2} & set(verified_frames(moving, front_end))
    assert "keyframe" in (*estimates[first + 1].events, *estimates[first + 2].events)


@pytest.mark.parametrize(("offset_s", "readout_s"), [(0.004, 0.0), (0.0, 0.02)])
def test_the_image_before_a_keyframe_is_tracked_if_delays_are_long(
    make_flight: MakeFlight, offset_s: float, readout_s: float
) -> None:
    """Its flow corrects for the delays; that of an image after several left-out ones is right, too."""
    flight = make_flight(1, rest_s=STATIONARY, duration_s=8.0, motion=CALM)
    camera = replace(flight.rig.cameras[0], readout_s=readout_s, time_offset_s=offset_s)
    late = replace(flight, rig=replace(flight.rig, cameras=(camera,)))
    front_end = VerifyingFrontEnd(late)
    estimates = late.run(front_end)
    missing = set(verified_frames(late, front_end))
    keyframes = [k for k, e in enumerate(estimates) if "keyframe" in e.events]
    assert not missing & {k - 1 for k in keyframes}
    assert len(missing) > 40
    sparse, every = (
        [r.innovation_px for e in run if (r := e.health_report) is not None and r.innovation_px is not None]
        for run in (estimates, late.run())
    )
    assert np.quantile(sparse, 0.9) < 1.3 * np.quantile(every, 0.9)
