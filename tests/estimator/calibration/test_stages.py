"""Which windows are adjusted when, and what becomes of their results, with an adjustment whose results are given."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import gtsam
import numpy as np
import pytest

from dronevio.estimator.calibration import online
from dronevio.estimator.calibration.adjustment import AdjustmentResult
from dronevio.estimator.calibration.online import OnlineCalibration
from dronevio.estimator.calibration.window import WindowKeyframe
from dronevio.estimator.imu.preintegration import Preintegration, PreintegrationConfig, PreintegrationParams
from dronevio.estimator.types import Matches, Observations
from dronevio.models.arrays import Array
from dronevio.models.rig_presets import rig_named
from dronevio.models.state import NavState

PERIOD_S = 0.3
"""Time between keyframes."""


@dataclass
class Adjustments:
    """Stands in for the adjustments, and records the windows that it is given."""

    mean: Array
    """Corrections by each adjustment."""
    steps: int = 1
    """Number of steps of each adjustment."""
    fit: tuple[float, float] = (0.5, 0.9)
    """Reprojection error [px] and agreement of each result."""
    landmarks: Callable[[int], int] = lambda index: 100
    """Number of landmarks of each window by its index."""
    windows: list[tuple[WindowKeyframe, ...]] = field(default_factory=list)
    """The keyframes of each window."""
    information: list[Array] = field(default_factory=list)
    """Information matrices of their priors."""

    def of(self, keyframes: tuple[WindowKeyframe, ...], *arguments: object, **_: object) -> "Problem":
        """Return an adjustment in place of its objective; see `CalibrationObjective.of`."""
        information = arguments[3]
        assert isinstance(information, np.ndarray)
        self.windows.append(keyframes)
        self.information.append(information)
        return Problem(self, keyframes, self.landmarks(len(self.windows) - 1))


@dataclass
class Problem:
    """An adjustment under way."""

    given: Adjustments
    keyframes: tuple[WindowKeyframe, ...]
    landmark_count: int
    steps: int = 0

    @property
    def is_done(self) -> bool:
        return self.steps >= self.given.steps

    @property
    def result(self) -> AdjustmentResult:
        n = len(self.given.mean)
        newest = self.keyframes[-1].state
        return AdjustmentResult(self.given.mean.copy(), 1e14 * np.eye(n), *self.given.fit, newest, np.zeros((15, n)))

    def step(self) -> None:
        self.steps += 1


def corrections(time_offset_s: float = 0.0, gravity_m_s2: float = 0.0, cameras: int = 1) -> Array:
    """Return the vector of corrections."""
    return np.asarray(np.r_[time_offset_s, gravity_m_s2, 0.0, np.zeros(10 * cameras)], np.float64)


def fed(
    monkeypatch: pytest.MonkeyPatch, adjustments: Adjustments, stationary: Iterable[bool], rig: str = "euroc"
) -> tuple[OnlineCalibration, list[float]]:
    """Return a calibration after keyframes, and the times at which it was corrected [s]."""
    monkeypatch.setattr(online, "CalibrationObjective", adjustments)
    monkeypatch.setattr(online, "CalibrationProblem", lambda adjustment, *_: adjustment)
    calibration, corrected_s = OnlineCalibration(rig_named(rig)), list[float]()
    params = PreintegrationParams.of(rig_named(rig).imu, PreintegrationConfig())
    pim = Preintegration(params, gtsam.imuBias.ConstantBias()).measurements
    ids, xy = np.arange(40), np.zeros((40, 2))
    matches = Matches(ids, np.ones(40, np.int64), xy)
    camera = np.zeros(40, np.int64)
    seen = Observations(ids, xy, xy, camera, matches=matches) if rig != "euroc" else Observations(ids, xy, xy, camera)
    for i, is_stationary in enumerate(stationary):
        state = NavState(round(PERIOD_S * i * 1e9), np.eye(4), np.zeros(3), np.zeros(3), np.zeros(3), 1e-4 * np.eye(15))
        if calibration.add(state, np.zeros(3), pim, seen, is_stationary):
            corrected_s.append(PERIOD_S * i)
    return calibration, corrected_s


def times_s(window: tuple[WindowKeyframe, ...]) -> list[float]:
    """Return the times of the first and last keyframe [s]."""
    return [window[0].state.t_ns * 1e-9, window[-1].state.t_ns * 1e-9]


def test_an_adjustment_goes_on_if_the_next_has_few_landmarks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first part, of 1.2 s, takes four steps; the longer ones after it see too little."""
    adjustments = Adjustments(corrections(time_offset_s=0.002), 4, landmarks=lambda index: 100 if index == 0 else 3)
    calibration, corrected_s = fed(monkeypatch, adjustments, [True] + [False] * 12)
    assert times_s(adjustments.windows[0]) == pytest.approx([0.0, 1.2])
    assert len(adjustments.windows) > 1
    assert corrected_s == pytest.approx([3.3]) and calibration.applied.time_offset_s == 0.002


@pytest.mark.parametrize(("fit", "is_used"), [((1.9, 0.6), True), ((2.1, 0.6), False), ((1.9, 0.4), False)])
def test_windows_whose_observations_disagree_correct_nothing(
    monkeypatch: pytest.MonkeyPatch, fit: tuple[float, float], is_used: bool
) -> None:
    adjustments = Adjustments(corrections(time_offset_s=0.002), fit=fit)
    _, corrected_s = fed(monkeypatch, adjustments, [True] + [False] * 12)
    assert bool(corrected_s) == is_used and adjustments.windows


def test_a_part_of_a_window_corrects_the_calibration(monkeypatch: pytest.MonkeyPatch) -> None:
    """One that does not leaves the prior as it was, also its time, so that no random walk is added."""
    adjustments = Adjustments(corrections())
    calibration, corrected_s = fed(monkeypatch, adjustments, [True] + [False] * 18)
    assert not corrected_s and str(calibration.applied) == "none"
    fed(monkeypatch, adjustments, [True] + [False] * 19)
    assert times_s(adjustments.windows[-1]) == pytest.approx([0.0, 5.1])
    np.testing.assert_array_equal(adjustments.information[-1], adjustments.information[0])
    calibration, corrected_s = fed(monkeypatch, Adjustments(corrections(time_offset_s=0.002)), [True] + [False] * 6)
    assert len(corrected_s) == 1 and calibration.applied.time_offset_s == 0.002


def test_gravity_is_kept_by_a_window_that_begins_at_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    """A window in motion finds half of the smallest correction, which is not applied."""
    adjustments = Adjustments(corrections(gravity_m_s2=0.005))
    in_motion = [False] * 18
    calibration, _ = fed(monkeypatch, adjustments, [*in_motion, True, True])
    assert calibration.estimate.gravity_m_s2 == 0.005 and not calibration.applied.gravity_m_s2
    adjustments = Adjustments(corrections(gravity_m_s2=0.005))
    monkeypatch.setattr(adjustments, "landmarks", lambda index: _without_gravity(adjustments, index))
    calibration, _ = fed(monkeypatch, adjustments, [*in_motion, True, True, *in_motion, False])
    assert len(adjustments.windows) > 1
    assert calibration.estimate.gravity_m_s2 == 0.005


def _without_gravity(adjustments: Adjustments, index: int) -> int:
    """Set the corrections that are returned of the windows after the first."""
    adjustments.mean = corrections(gravity_m_s2=0.005 if index == 0 else 0.0)
    return 100


def test_keyframes_before_a_corrected_state_are_not_continued(monkeypatch: pytest.MonkeyPatch) -> None:
    """After a large correction by a complete window from rest; a small one continues the window under way."""
    for offset_s, first_s in ((0.006, 6.0), (0.0015, 5.4)):
        monkeypatch.setattr(online, "propagated_state", lambda state, *_: state)
        adjustments = Adjustments(corrections(time_offset_s=offset_s))
        monkeypatch.setattr(adjustments, "landmarks", lambda index, a=adjustments: 100 * (len(a.windows[-1]) > 17))
        _, corrected_s = fed(monkeypatch, adjustments, [True] + [False] * 40)
        assert corrected_s[0] == pytest.approx(5.7)
        complete = [window for window in adjustments.windows if len(window) > 17]
        assert times_s(complete[0]) == pytest.approx([0.0, 5.1])
        assert times_s(complete[1])[0] == pytest.approx(first_s)


def test_cameras_are_compared_once(monkeypatch: pytest.MonkeyPatch) -> None:
    adjustments = Adjustments(corrections(cameras=2))
    fed(monkeypatch, adjustments, [True] * 5, rig="euroc-stereo")
    assert [times_s(window) for window in adjustments.windows] == [[0.0, 0.0]]
