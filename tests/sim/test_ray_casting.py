"""Distances of surfaces along rays."""

import numpy as np
import pytest

from dronevio.models.errors import ConfigError
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.sim.ray_casting import RayCaster, surface_points
from dronevio.sim.world import flight_area, illumination_and_movers

UP, DOWN, AHEAD = [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]


def poses(*positions: list[float], yaw_rad: float = 0.0) -> np.ndarray:
    return pose_matrix(np.tile(rotation_z(yaw_rad), (len(positions), 1, 1)), np.array(positions))


def test_floor_and_ceiling_of_the_station_by_hand() -> None:
    high = flight_area("repetitive", 0).space.high[2]
    # Beside the pad and the columns, and not below a lamp.
    found = RayCaster("repetitive", 0).ranges_m(poses([1.0, 1.5, 1.3], [1.0, 1.5, 2.0]), np.array([UP, DOWN]))
    np.testing.assert_allclose(found, [[high - 1.3, 1.3], [high - 2.0, 2.0]], atol=1e-6)


def test_rays_turn_with_the_camera() -> None:
    caster, place = RayCaster("room", 1), [0.3, 0.2, 1.4]
    ahead, left = (caster.ranges_m(poses(place, yaw_rad=yaw), np.array([AHEAD]))[0, 0] for yaw in (0.0, 0.5 * np.pi))
    same = caster.ranges_m(poses(place), np.array([AHEAD, [0.0, 1.0, 0.0]]))[0]
    np.testing.assert_allclose([ahead, left], same, atol=1e-9)
    assert ahead <= 3.7 + 1e-6 and left <= 2.8 + 1e-6  # the room measures 8 × 6 m


def test_rays_without_a_surface_or_a_direction() -> None:
    caster = RayCaster("forest", 0)
    found = caster.ranges_m(poses([0.0, 0.0, 1.3]), np.array([[0.1, 0.0, 0.995], DOWN, [np.nan] * 3]), farthest_m=30.0)
    assert found[0, 0] == np.inf  # the sky
    assert found[0, 1] == pytest.approx(1.3, abs=0.2)  # the pad is above the ground
    assert np.isnan(found[0, 2])


def test_rays_pass_moving_objects() -> None:
    mover = illumination_and_movers("moving", 1)[1][0]
    person = mover.poses(np.zeros(1))[0, :3, 3]
    above = [[float(person[0]), float(person[1]), 2.3]]
    assert RayCaster("moving", 1).ranges_m(poses(*above), np.array([DOWN]))[0, 0] == pytest.approx(2.3, abs=1e-6)


def test_rays_meet_moving_objects_where_they_are_at_a_time() -> None:
    mover, times = illumination_and_movers("moving", 1)[1][0], np.array([0.0, 3.0])
    above = [[float(x), float(y), 2.3] for x, y, _ in mover.poses(times)[:, :3, 3]]
    caster, down = RayCaster("moving", 1), np.array([DOWN])
    there = caster.ranges_m(poses(*above), down, movers_at_s=times)[:, 0]
    assert (there > 0.2).all() and (there < 0.9).all()  # heads at 1.6 to 1.9 m
    assert caster.ranges_m(poses(*above), down)[:, 0] == pytest.approx([2.3, 2.3], abs=1e-6)


def test_surface_points_lie_on_what_rays_meet() -> None:
    found = surface_points("repetitive", 0, 0.2)
    chosen = found.points_m[found.instance == found.names.index("ceiling")]
    assert len(chosen) == 80 * 48  # 16 × 9.6 m
    np.testing.assert_allclose(chosen[:, 2], flight_area("repetitive", 0).space.high[2], atol=1e-9)
    above = chosen[5][:2].tolist()
    assert RayCaster("repetitive", 0).ranges_m(poses([*above, 1.0]), np.array([UP]))[0, 0] == pytest.approx(3.2)
    with pytest.raises(ConfigError, match="spacing"):
        surface_points("room", 0, 0.0)


def test_an_unknown_world_is_refused() -> None:
    with pytest.raises(ConfigError, match="moon"):
        RayCaster("moon", 0)
