import numpy as np
import pytest

from dronevio.models.quadrotor import Quadrotor

FRONT_RIGHT, REAR_LEFT, FRONT_LEFT, REAR_RIGHT = range(4)


def test_rotors_stand_where_their_names_say() -> None:
    x, y, _ = Quadrotor().rotor_positions_m.T
    assert x[FRONT_RIGHT] > 0 > y[FRONT_RIGHT]
    assert x[REAR_LEFT] < 0 < y[REAR_LEFT]
    assert x[FRONT_LEFT] > 0 and y[FRONT_LEFT] > 0
    assert x[REAR_RIGHT] < 0 and y[REAR_RIGHT] < 0
    np.testing.assert_allclose(np.hypot(x, y), Quadrotor().arm_m)


def test_equal_rotors_lift_without_turning() -> None:
    quadrotor = Quadrotor()
    wrench = quadrotor.allocation @ np.full(4, quadrotor.hover_speed_rad_s**2)
    np.testing.assert_allclose(wrench, [1.5 * 9.81, 0.0, 0.0, 0.0], atol=1e-12)


@pytest.mark.parametrize(
    ("rotor", "signs"),
    [(FRONT_RIGHT, (-1, -1, -1)), (REAR_LEFT, (1, 1, -1)), (FRONT_LEFT, (1, -1, 1)), (REAR_RIGHT, (-1, 1, 1))],
)
def test_each_rotor_turns_the_body_the_right_way(rotor: int, signs: tuple[int, int, int]) -> None:
    # left rotors roll right (+x), rear ones pitch the nose down (+y), clockwise ones yaw left (+z)
    squares = np.zeros(4)
    squares[rotor] = 1e5
    np.testing.assert_array_equal(np.sign(Quadrotor().allocation[1:] @ squares), signs)


def test_motors_can_lift_twice_the_weight() -> None:
    quadrotor = Quadrotor()
    ratio = (quadrotor.rotor_speed_max_rad_s / quadrotor.hover_speed_rad_s) ** 2
    assert 2.0 < ratio < 3.0
