"""The script that kidnaps visual SLAM: splices at revisits in the air, and what happened after them."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from dronevio.eval.metrics.revisits import Views
from dronevio.models.camera import CameraModel
from dronevio.models.rotation import inverse_pose, pose_matrix, rotation_z
from dronevio.models.state import Estimate, Health, NavState

CAMERA = CameraModel(640, 480, 400.0, 400.0, 319.5, 239.5)
SPLICE = 4_000_000_000
T_WORLD_MAP = pose_matrix(rotation_z(0.7), np.array([3.0, -1.0, 0.5]))


@pytest.fixture(scope="module")
def kidnappings(script: Callable[[str], Any]) -> Any:
    """The script."""
    return script("kidnappings")


def views_of(x_m: npt.ArrayLike, height_m: Sequence[float]) -> Views:
    """Views of a wall at 5 m, two seconds and two metres of path apart, at given places."""
    n = len(height_m)
    Ts = np.tile(np.eye(4), (n, 1, 1)).astype(np.float64)
    Ts[:, 0, 3], Ts[:, 2, 3] = x_m, height_m
    rays = CAMERA.unproject(np.stack(np.meshgrid(np.arange(16) * 40.0, np.arange(12) * 40.0), axis=-1))
    ranges = np.asarray(np.tile(5.0 / rays[..., 2], (n, 1, 1)), np.float64)
    return Views(2_000_000_000 * np.arange(n), np.linspace(0.0, 2.0 * (n - 1), n), Ts, CAMERA, ranges)


def estimates_of(kinds: str, jump_m: float = 0.0) -> tuple[list[Estimate], np.ndarray[Any, Any]]:
    """Estimates one second apart with their true poses: M with a map, T without one, L lost.

    The odometry frame is that of the map, and the poses after the splice err by ``jump_m``.
    """
    Ts = np.tile(np.eye(4), (len(kinds), 1, 1)).astype(np.float64)
    Ts[:, 0, 3] = np.arange(len(kinds))
    Ts = T_WORLD_MAP @ Ts
    found = []
    for row, kind in enumerate(kinds):
        T_map_imu = inverse_pose(T_WORLD_MAP) @ Ts[row]
        T_map_imu[1, 3] += jump_m if row >= 4 else 0.0
        t_ns = row * 1_000_000_000
        state = NavState(t_ns, T_map_imu, np.zeros(3), np.zeros(3), np.zeros(3))
        known = Estimate(t_ns, Health.TRACKING, state, T_map_odom=np.eye(4))
        other = {"M": known, "T": replace(known, T_map_odom=None), "L": replace(known, health=Health.LOST)}
        found.append(other[kind])
    return found, Ts


def test_times_and_errors_after_a_splice(kidnappings: Any) -> None:
    estimates, Ts = estimates_of("LMMMMLLTTMM", jump_m=0.12)
    found = kidnappings.outcome_of(estimates, Ts, SPLICE, np.full(11, 5.0))
    assert (found.start_s, found.joined_s) == (3.0, 5.0)  # tracks at 7 s, in the map at 9 s
    assert found.error_m == pytest.approx(0.12) and found.error_rad == pytest.approx(0.0, abs=1e-7)
    assert not found.wrong and found.in_time  # 5 cm + 2 % of 5 m are 15 cm
    assert kidnappings.outcome_of(estimates, Ts, SPLICE, np.full(11, 3.4)).wrong  # 11.8 cm


@pytest.mark.parametrize(
    ("kinds", "start_s", "joined_s", "in_time", "wrong"),
    [
        ("MMMMTTMM", 0.0, 2.0, True, False),  # the odometry goes on
        ("MMMMTTTMM", 0.0, 3.0, False, False),  # more than 2 s after it began
        ("MMMMLLLLTM", 4.0, 5.0, True, False),
        ("MMMMLLLLLM", 5.0, 5.0, True, False),
        ("MMMMLLLLLLM", 6.0, 6.0, False, False),  # more than 5 s after the splice
        ("MMMMLLTT", 2.0, None, False, False),
        ("MMMMLLL", None, None, False, False),
        ("MMMMMMM", 0.0, 0.0, True, False),  # the pose in the map is right all the time
    ],
)
def test_outcomes_by_hand(
    kidnappings: Any, kinds: str, start_s: float | None, joined_s: float | None, in_time: bool, wrong: bool
) -> None:
    estimates, Ts = estimates_of(kinds)
    found = kidnappings.outcome_of(estimates, Ts, SPLICE, np.full(len(kinds), 5.0))
    assert (found.start_s, found.joined_s, found.in_time, found.wrong) == (start_s, joined_s, in_time, wrong)


def test_a_wrong_place_that_is_not_noticed_is_wrong(kidnappings: Any) -> None:
    depth_m = np.full(8, 5.0)
    estimates, Ts = estimates_of("MMMMMMMM", jump_m=0.3)
    found = kidnappings.outcome_of(estimates, Ts, SPLICE, depth_m)
    assert found.wrong and found.joined_s is None
    estimates = [*estimates[:6], *estimates_of("MMMMMMMM")[0][6:]]
    assert kidnappings.outcome_of(estimates, Ts, SPLICE, depth_m).wrong  # it reports that it tracks
    estimates[4:6] = [replace(estimate, health=Health.INERTIAL_ONLY) for estimate in estimates[4:6]]
    found = kidnappings.outcome_of(estimates, Ts, SPLICE, depth_m)
    assert not found.wrong and (found.start_s, found.joined_s) == (0.0, 2.0) and found.in_time


def test_an_error_before_the_splice_is_allowed_for(kidnappings: Any) -> None:
    estimates, Ts = estimates_of("MMMMTMMM", jump_m=0.3)
    assert kidnappings.outcome_of(estimates, Ts, SPLICE, np.full(8, 5.0)).wrong
    drifted = estimates[3].state
    assert drifted is not None
    T = drifted.T_world_imu.copy()
    T[1, 3] += 0.2
    estimates[3] = replace(estimates[3], state=replace(drifted, T_world_imu=T))
    assert not kidnappings.outcome_of(estimates, Ts, SPLICE, np.full(8, 5.0)).wrong


def test_a_splice_is_at_a_revisit_in_the_air(kidnappings: Any) -> None:
    x_m = np.concatenate([[0.0], np.arange(1.0, 13.0), [50.0, 5.0, 6.0, 7.0, 70.0, 80.0, 90.0, 90.0, 90.0, 90.0]])
    views = views_of(x_m, [0.0, *[1.0] * 22])
    rng = np.random.default_rng(0)
    found = {kidnappings.possible_splices(views, None, rng) for _ in range(40)}
    assert None not in found and len(found) > 3
    # The end is 10 s after the take-off at 2 s; revisits follow for four seconds after the one at 28 s only.
    assert {round(splice.start_s, 6) for splice in found} == {28.0} and min(s.end_s for s in found) > 11.9
    assert all(abs(x_m[round(s.end_s / 2.0)] - x_m[round(s.start_s / 2.0)]) > 1.0 for s in found)
    assert all(s.end_s < s.start_s for s in found)
    assert kidnappings.possible_splices(views[:17], None, rng) is None  # less than 10 s after the last revisit
    assert kidnappings.possible_splices(views_of(x_m, [0.0] * 23), None, rng) is None  # on the ground


def test_a_splice_with_another_flight_is_in_its_time(kidnappings: Any) -> None:
    first, second = (
        views_of(np.arange(12.0), [0.0, *[1.0] * 11]),
        views_of([0.0, 3.0, 4.0, 5.0, *[90.0] * 8], [0.0, *[1.0] * 11]),
    )
    rng = np.random.default_rng(0)
    found = {kidnappings.possible_splices(first, second, rng) for _ in range(20)}
    assert {round(splice.start_s, 6) for splice in found} == {2.0} and min(s.end_s for s in found) > 11.9
    assert kidnappings.possible_splices(first, views_of([99.0] * 9, [0.0, *[1.0] * 8]), rng) is None


def test_rows_state_what_is_in_time(kidnappings: Any) -> None:
    splice = kidnappings.Splice(12.0, 28.5)
    found = kidnappings.Outcome(1.0, 2.5, 0.0126, 0.01, wrong=False)
    assert tuple(kidnappings.row_of(3, ("a", "b"), splice, found).values()) == (
        "3: `a` + `b`", "12.0, 28.5", "1.00", "2.50", "1.50", "13", "0.57", "in time"
    )  # fmt: skip
    lost = kidnappings.Outcome(None, None, None, None, wrong=False)
    assert tuple(kidnappings.row_of(0, ("a", "a"), splice, lost).values())[0::7] == ("0: `a`", "not joined")
