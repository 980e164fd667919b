"""Range beams of the environments: distances by geometry, errors, rates and states."""

import pickle
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dronevio.envs import BeamSettings, DroneEnv, DroneVectorEnv
from dronevio.models.errors import ConfigError
from dronevio.sim.physics.vehicle_states import VehicleStates
from dronevio.sim.world import solid_space

EXACT: dict[str, Any] = {"sigma_m": 0.0, "relative_sigma": 0.0, "lost": 0.0}
LEVEL = {"velocity_m_s": np.zeros(3), "rate_rad_s": np.zeros(3), "quat_wxyz": np.array([1.0, 0.0, 0.0, 0.0])}
HOVER = np.zeros(4, np.float32)


def ranges(env: DroneEnv, **options: Any) -> np.ndarray:
    """Return the ranges after a reset with some options."""
    observation, _ = env.reset(seed=0, options={**LEVEL, **options})
    return np.asarray(observation["ranges"])


def test_a_beam_downwards_is_an_altimeter() -> None:
    down = BeamSettings(beams=(1, 1), pitch_deg=90.0, position_m=(0.0, 0.0, -0.05), **EXACT)
    env = DroneEnv(observations=("ranges", "height"), beams=down)
    for height_m in (0.7, 1.3):
        seen, _ = env.reset(seed=0, options={**LEVEL, "position_m": np.array([0.0, 0.0, height_m])})
        assert seen["ranges"][0, 0] == pytest.approx(seen["height"][0] - 0.05, abs=1e-6)


@pytest.mark.parametrize("world", ["room", "office"])
def test_distances_are_those_to_the_boxes_of_the_world(world: str) -> None:
    """Slab by slab, and up to the floor and the walls, where the space of the world ends."""
    settings = BeamSettings(beams=(24, 6), field_deg=(360.0, 100.0), reach_m=100.0, **EXACT)
    env = DroneEnv("explore", world=world, observations=("ranges",), beams=settings)
    space, turn = solid_space(world, 0), Rotation.from_euler("ZYX", [0.3, 0.2, -0.1])
    q = np.roll(turn.as_quat(), 1)
    env.reset(seed=3)
    place = env._core.states.position_m[0]
    found = ranges(env, position_m=place, quat_wxyz=q).ravel()
    rays = turn.apply(settings.directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        leaves = np.fmin.reduce(np.maximum((space.low - place) / rays, (space.high - place) / rays), axis=1)
        local = np.einsum("kij,bi->bkj", space.rotations, rays)
        to_centre = np.einsum("kij,ki->kj", space.rotations, space.centres - place)
        sides = np.stack([(to_centre - space.halves) / local, (to_centre + space.halves) / local])
    enter, leave = sides.min(axis=0).max(axis=2), sides.max(axis=0).min(axis=2)
    nearest = np.where((enter <= leave) & (enter > 0.0), enter, np.inf).min(axis=1)
    expected = np.minimum(nearest, leaves)
    agrees = np.abs(found - expected) < 2e-3
    assert agrees.mean() > 0.97  # curved solids are boxes in the space
    assert np.ptp(found) > 1.0


def test_a_full_circle_turns_with_the_vehicle() -> None:
    circle = BeamSettings(beams=(8, 1), field_deg=(360.0, 0.0), reach_m=50.0, **EXACT)
    env = DroneEnv(observations=("ranges",), beams=circle)
    place = np.array([0.3, -0.2, 1.2])
    ahead = ranges(env, position_m=place)
    left = ranges(env, position_m=place, quat_wxyz=np.array([0.5**0.5, 0.0, 0.0, 0.5**0.5]))
    np.testing.assert_allclose(np.roll(left, -2), ahead, atol=1e-5)
    behind = ranges(
        DroneEnv(observations=("ranges",), beams=BeamSettings(**{**vars(circle), "yaw_deg": 180.0})), position_m=place
    )
    np.testing.assert_allclose(np.roll(behind, 4), ahead, atol=1e-5)
    assert np.ptp(ahead) > 0.5


def test_errors_have_the_stated_size() -> None:
    noisy = BeamSettings(beams=(200, 40), reach_m=8.0, sigma_m=0.03, relative_sigma=0.04, lost=0.2)
    place = np.array([0.0, 0.0, 1.2])
    exact = replace(noisy, **EXACT)
    true, seen = (ranges(DroneEnv(observations=("ranges",), beams=b), position_m=place) for b in (exact, noisy))
    is_lost = seen == 8.0
    assert true.max() < 7.0 and is_lost.mean() == pytest.approx(0.2, abs=0.02)
    scaled = ((seen - true) / np.hypot(0.03, 0.04 * true))[~is_lost]
    assert abs(scaled.mean()) < 0.05 and scaled.std() == pytest.approx(1.0, abs=0.03)


def test_nothing_within_reach_is_the_reach() -> None:
    near = BeamSettings(reach_m=0.2)
    env = DroneEnv(observations=("ranges",), beams=near)
    assert (ranges(env, position_m=np.array([0.0, 0.0, 1.2])) == np.float32(0.2)).all()
    assert env.observation_space["ranges"].shape == (8, 8)  # type: ignore[index]


def test_measurements_have_their_rate() -> None:
    env = DroneEnv(observations=("ranges",), beams=BeamSettings(rate_hz=10.0))
    seen = [env.reset(seed=0)[0]["ranges"]]
    seen += [env.step(HOVER)[0]["ranges"] for _ in range(11)]
    changes = [k for k in range(1, 12) if not np.array_equal(seen[k], seen[k - 1])]
    assert changes == [5, 10]
    with pytest.raises(ConfigError, match=r"beams\.rate_hz = 15 with action_rate_hz = 50"):
        DroneEnv(observations=("ranges",), beams=BeamSettings(rate_hz=15.0))
    DroneEnv(beams=BeamSettings(rate_hz=15.0))  # without beams


def test_states_and_seeds_include_the_beams() -> None:
    env = DroneEnv(observations=("ranges",), beams=BeamSettings(rate_hz=25.0))
    env.reset(seed=4)
    env.step(HOVER)
    saved = env.save_state()
    expected = [env.step(HOVER)[0]["ranges"] for _ in range(5)]
    copy = pickle.loads(pickle.dumps(env))
    env.restore_state(saved)
    np.testing.assert_array_equal([env.step(HOVER)[0]["ranges"] for _ in range(5)], expected)
    np.testing.assert_array_equal(copy.step(HOVER)[0]["ranges"], env.step(HOVER)[0]["ranges"])
    first, again = (env.reset(seed=4)[0]["ranges"] for _ in range(2))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, env.reset(seed=5)[0]["ranges"])


def test_rows_of_a_vector_are_measured_apart() -> None:
    beams = BeamSettings(**EXACT)
    envs = DroneVectorEnv(3, observations=("ranges", "position"), beams=beams, autoreset_mode="DISABLED")
    seen, _ = envs.reset(seed=0)
    single = DroneEnv(observations=("ranges",), beams=beams)
    states: VehicleStates = envs._core.states
    q = np.roll(Rotation.from_matrix(states.R_world_vehicle[1]).as_quat(), 1)
    same = ranges(single, position_m=states.position_m[1], quat_wxyz=q)
    np.testing.assert_allclose(seen["ranges"][1], same, atol=1e-5)
    again, _ = envs.reset(options={"reset_mask": np.array([False, True, False])})
    np.testing.assert_array_equal(again["ranges"][[0, 2]], seen["ranges"][[0, 2]])
    assert not np.array_equal(again["ranges"][1], seen["ranges"][1])
