"""The examples of policies that see: the expert of Navigate, DAgger, and the white wall."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import dronevio as dv
from dronevio.envs import DroneVectorEnv, OwnObservation, Randomization, policy_from_torch
from dronevio.models.policies import Provenance
from dronevio.sim.envs.tasks.task import PointGoals, Transition
from dronevio.sim.physics.vehicle_states import VehicleStates


def test_the_expert_flies_around_trees(example: Any) -> None:
    """Straight flights of two of these episodes end at a tree."""
    seeds, count = (3, 5), 12
    place = OwnObservation("place", (3,), -100.0, 100.0, lambda state: state.states.position_m)
    envs: Any = gymnasium.make_vec(
        "dronevio.envs:dronevio/Navigate-v0",
        count,
        observations=("goals", "rotation"),
        privileged=(place,),
        action_rate_hz=10.0,
        randomization=Randomization(world_seeds=seeds),
    )
    observation, infos = envs.reset(seed=1)
    expert = example("expert").Expert("forest", seeds, count, envs.unwrapped.settings.action_limits)
    seen = observation["policy"]
    goals = observation["critic"]["place"] + np.matvec(seen["rotation"], seen["goals"][:, 0])
    expert.begin(np.arange(count), infos["randomization"]["world_seed"], goals.astype(np.float64))
    running, succeeded = np.ones(count, np.bool_), np.zeros(count, np.bool_)
    while running.any():
        state = (observation["critic"]["place"], observation["policy"]["rotation"])
        actions = expert.action(*(part.astype(np.float64) for part in state))
        observation, _, terminated, truncated, infos = envs.step(actions)
        succeeded |= running & infos["success"]
        running &= ~(terminated | truncated)
    assert succeeded.all()


def test_paths_keep_their_distance_and_lead_to_the_goal(example: Any) -> None:
    space, goal = example("expert").FreeSpace("forest", 0), np.array([0.1, 0.2, 1.5])
    following = space.next_cells(goal)
    for start in ([10.0, 0.0, 1.6], [-10.0, 6.0, 2.0], [4.0, -8.0, 1.2]):
        place, length_m = np.array(start), 0.0
        for _ in range(20):
            path = space.path(following, place)
            if not len(path):
                break
            length_m += np.linalg.norm(np.diff(np.vstack([place, path]), axis=0), axis=1).sum()
            assert space.clearance_m(path[1:]).min() > 0.2
            place = path[-1]
        assert np.linalg.norm(place - goal) < 0.2 and length_m < 1.6 * np.linalg.norm(np.array(start) - goal)


def test_a_mirrored_sample_is_that_of_the_mirrored_world(example: Any) -> None:
    pytest.importorskip("torch")
    dagger = example("dagger")
    rng, samples = np.random.default_rng(0), dagger.Samples(1)
    R = np.linalg.qr(rng.normal(size=(3, 3)))[0].astype(np.float32)
    R *= np.sign(np.linalg.det(R))
    depth = rng.uniform(0.0, 6.0, (1, 64, 64, 1)).astype(np.float32)
    seen = {"depth": depth, "goals": np.array([[[2.0, 1.0, 0.5]]]), "rotation": R[None]}
    seen |= {"body_velocity": np.array([[1.0, 0.3, -0.2]]), "last_action": np.array([[0.1, 0.2, 0.3, 0.4]])}
    samples.add(seen, np.array([[0.5, -0.6, 0.7, -0.8]]))
    found = set()
    for seed in range(8):
        image, others, action = (one.numpy()[0] for one in samples.drawn(1, np.random.default_rng(seed)))
        is_mirrored = bool(action[1] > 0.0)
        found.add(is_mirrored)
        side = np.array([1.0, -1.0 if is_mirrored else 1.0, 1.0])
        expected = depth[0, :, ::-1, 0] if is_mirrored else depth[0, :, :, 0]
        np.testing.assert_allclose(image, dagger.scaled_depth(expected), atol=0.013)
        np.testing.assert_allclose(others[:3], side * [0.5, 0.25, 0.125], atol=1e-6)
        turned = others[3:12].reshape(3, 3)
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-5)
        assert np.linalg.det(turned) == pytest.approx(1.0, abs=1e-5)
        np.testing.assert_allclose(turned[2], side * R[2], atol=1e-6)  # where gravity points does not change
        np.testing.assert_allclose(others[12:15], side * [1.0, 0.3, -0.2], atol=1e-6)
        np.testing.assert_allclose(action, [0.5, -0.6 * side[1], 0.7, -0.8 * side[1]], atol=1e-6)
    assert found == {False, True}


@pytest.mark.parametrize("blind", [False, True])
def test_the_policy_acts_as_the_learner(example: Any, blind: bool) -> None:
    torch = pytest.importorskip("torch")
    dagger = example("dagger")
    envs = DroneVectorEnv(3, "navigate", observations=dagger.NAMES[blind:], world="low-texture", action_rate_hz=10.0)
    learner, origin = dagger.Learner(19, blind), Provenance("DAgger", 0, 0)
    made = {"convolutions": learner.convolutions, "scaling": dagger.policy_scaling(blind)}
    policy = policy_from_torch(learner.layers, envs, origin, environment="dronevio/Navigate-v0", **made)
    seen, _ = envs.reset(seed=0)
    depth = np.zeros((3, 0)) if blind else dagger.scaled_depth(seen["depth"][..., 0])
    inputs = (torch.from_numpy(part.astype(np.float32)) for part in (depth, dagger.scaled_others(seen)))
    with torch.no_grad():
        np.testing.assert_allclose(policy.action(seen), learner(*inputs).numpy(), atol=1e-5)
    envs.close()


@pytest.mark.parametrize("blind", [False, True])
def test_a_short_training_by_dagger(
    example: Any, blind: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("torch")
    dagger = example("dagger")
    monkeypatch.setattr(dagger, "TRAINING_WORLDS", (0, 1))
    short = {"rounds": 2, "steps": 3, "envs": 4, "updates": 2, "worlds": 2, "out": tmp_path}
    dagger.main(dagger.DaggerCommand(blind=blind, **short))
    name = dagger.name_of(blind)
    policy = dv.load_policy(tmp_path / f"{name}-0.safetensors")
    assert policy.names == dagger.NAMES[blind:] and (policy.network.encoder is None) == blind
    result = json.loads((tmp_path / f"{name}-0.json").read_text(encoding="utf-8"))
    assert result["curve"]["samples"] == "12 24" and sum(result["evaluation"].values()) == 2
    dagger.draw(tmp_path, tmp_path / "curves.svg")
    assert f"| {name} | 0 |" in capsys.readouterr().out and (tmp_path / "curves.svg").stat().st_size > 1000


@pytest.mark.slow
def test_the_committed_policy_reaches_goals_in_unseen_forests(example: Any) -> None:
    policy = dv.load_policy(example("curves").HERE / "policies" / "navigate-depth.safetensors")
    result = dv.evaluate_policy(policy, 10, 5, world_seeds=range(20_000, 20_010), world="forest")
    assert result.success.sum() >= 8


def test_the_white_wall_is_a_task(example: Any) -> None:
    pytest.importorskip("stable_baselines3")
    wall = example("white_wall")
    task = wall.WhiteWall(spread_rad=0.0)
    envs = DroneVectorEnv(5, task, flat=False, **wall.FLIGHT)
    seen, _ = envs.reset(seed=0)
    goal_m = seen["goals"][:, 0]
    assert (goal_m[:, 0] > 4.0).all() and (np.abs(goal_m[:, 1]) < 1e-5).all()  # they head for their goals
    envs.close()
    goals = PointGoals(np.array([[4.4, 0.0, 1.5]] * 3))
    places = np.array([[4.4, 0.25, 1.5], [4.4, 0.35, 1.5], [4.4, 0.0, 1.5]])
    step = SimpleNamespace(t_s=task.episode_s - np.array([0.2, 0.2, 1.0]), after=VehicleStates.at(places))
    assert task.success(goals, step).tolist() == [True, False, False]


def test_the_white_wall_rewards_a_small_uncertainty(example: Any) -> None:
    """By its logarithm: a tenth costs ln 10 less, and what is below 1 cm nothing."""
    pytest.importorskip("stable_baselines3")
    wall = example("white_wall")
    task, goals = wall.WhiteWall(uncertainty=0.5), PointGoals(np.tile([4.4, 0.0, 1.5], (3, 1)))
    at = VehicleStates.at(np.zeros((3, 3)))
    sigma_m = np.array([0.005, 0.01 * np.e, 0.1 * np.e])
    step = Transition(
        at, at, np.zeros((3, 4)), np.zeros((3, 4)), np.ones(3), np.zeros(3, bool), position_sigma_m=sigma_m
    )
    terms = task.reward_terms(goals, goals, step)
    np.testing.assert_allclose(terms["uncertainty"], [0.0, -0.5, -0.5 - 0.5 * np.log(10.0)], atol=1e-12)


def test_the_white_wall_in_a_short_training(example: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("stable_baselines3")
    wall = example("white_wall")
    monkeypatch.setattr(wall, "flown", lambda policy, episodes: [{"names": policy.names, "episodes": episodes}])
    wall.main(wall.TrainCommand(samples=0, true_samples=1920, episodes=2, out=tmp_path))
    result = json.loads((tmp_path / "white-wall-truth-0.json").read_text(encoding="utf-8"))
    assert result["flights"] == [{"names": list(wall.WhiteWall.default_observations), "episodes": 2}]


def test_the_picture_of_the_white_wall(example: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Errors are those at the end of the flights: their median, and the largest."""
    pytest.importorskip("stable_baselines3")
    wall = example("white_wall")
    t = np.arange(0.2, 20.1, 0.2)

    def flight(final_m: float, distance_m: float) -> dict[str, Any]:
        columns = {"t_s": t, "x_m": 0.2 * t, "y_m": 0.0 * t, "yaw_deg": 4.0 * t, "error_m": final_m * t / t[-1] + 1e-3}
        log = {name: " ".join(map(str, values)) for name, values in columns.items()}
        return {"success": distance_m < 0.3, "distance_m": distance_m, "log": log}

    flights = [flight(0.03, 0.1), flight(0.05, 0.2), flight(4.0, 3.9)]
    document = {"name": "truth", "seed": 0, "cpu_s": 600, "flights": flights}
    (tmp_path / "white-wall-truth-0.json").write_text(json.dumps(document), encoding="utf-8")
    wall.main(wall.DrawCommand(tmp_path / "wall.svg", tmp_path))
    assert "<svg" in (tmp_path / "wall.svg").read_text(encoding="utf-8")
    assert "| true state | 0 | 67% | 0.05 | 4.00 | 0.20 | 10 |" in capsys.readouterr().out
