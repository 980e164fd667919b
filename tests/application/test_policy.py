"""Evaluation, description and export of policies, as functions and commands."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dronevio as dv
from dronevio import policy_evaluation
from dronevio.cli import main
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuSamples
from dronevio.models.policies import Layer, NamedShape, Network, Policy, Scaling
from dronevio.models.rig import Rig
from dronevio.models.state import CameraFrame, Estimate, Health, NavState
from dronevio.sim.envs import DroneEnv, Hover, Navigate, VioHover
from dronevio.sim.envs.policies.environments import policy_envs
from dronevio.sim.envs.vector import DroneVectorEnv


@pytest.fixture
def saved(hovering_policy: Policy, tmp_path: Path) -> Path:
    path = tmp_path / "linear.safetensors"
    dv.save_policy(path, hovering_policy)
    return path


def falling(policy: Policy) -> Policy:
    """A policy that stops the rotors."""
    layer = Layer(np.zeros((4, 15), np.float32), np.array([-5.0, 0.0, 0.0, 0.0], np.float32))
    return replace(policy, network=Network((layer,), "tanh"))


def of_two_samples(policy: Policy) -> Policy:
    """A policy of two IMU samples, as no environment has them at its rates."""
    layer = Layer(np.zeros((4, 12), np.float32), np.zeros(4, np.float32))
    inputs, network = (NamedShape("imu", (2, 6)),), Network((layer,), "tanh")
    return replace(policy, inputs=inputs, scaling=Scaling.identity(12), network=network)


class Standing:
    """An estimator for which the vehicle stands at its start for ever."""

    def __init__(self, rig: Rig) -> None:
        self.T_world_imu = rig.T_vehicle_imu

    def add_imu(self, samples: ImuSamples) -> None:
        pass

    def state_at(self, t_ns: int) -> NavState:
        zero = np.zeros(3)
        return NavState(t_ns, self.T_world_imu, zero, zero, zero, angular_velocity_rad_s=zero)

    def add_frame(self, frame: CameraFrame) -> Estimate:
        return Estimate(frame.t_ns, Health.TRACKING, replace(self.state_at(frame.t_ns), covariance=1e-4 * np.eye(15)))


def test_a_controller_hovers_in_all_episodes(hovering_policy: Policy) -> None:
    result = dv.evaluate_policy(hovering_policy, 8, seed=3, task=Hover(episode_s=5.0))
    figures = result.figures()
    assert figures["success_rate"] == 1.0 and figures["crash_rate"] == 0.0 and figures["lap_s"] is None
    assert result.counts() == {"time limit": 8} and figures["duration_s"] == figures["success_duration_s"] == 5.0
    distance = figures["final_distance_m"]
    assert distance is not None and 0.0 < distance < 0.06
    assert 0.6 * 250 < float(result.reward.min()) < 250  # a reward of 1 per step at perfect hover


def test_crashes_are_counted_by_reason(hovering_policy: Policy) -> None:
    result = dv.evaluate_policy(falling(hovering_policy), 6)
    figures = result.figures()
    assert (figures["success_rate"], figures["crash_rate"], figures["success_duration_s"]) == (0.0, 1.0, None)
    assert sum(result.counts().values()) == 6 and set(result.counts()) <= {"ground", "collision", "flipped"}
    assert 0.2 < result.duration_s.min() <= result.duration_s.max() < 1.5
    assert (result.distance_m > 0.8).all()


def test_episodes_depend_on_the_seed_alone(hovering_policy: Policy) -> None:
    task = Hover(episode_s=0.5)
    first, again, other = (dv.evaluate_policy(hovering_policy, 4, seed, task=task) for seed in (1, 1, 2))
    np.testing.assert_array_equal(first.distance_m, again.distance_m)
    assert not np.isin(first.distance_m, other.distance_m).any()


def test_episodes_are_in_the_given_worlds(hovering_policy: Policy, monkeypatch: pytest.MonkeyPatch) -> None:
    flown: list[int] = []
    plain = DroneVectorEnv.reset

    def reset(self: DroneVectorEnv, **arguments: Any) -> Any:
        observation, info = plain(self, **arguments)
        flown.extend(info["randomization"]["world_seed"])
        return observation, info

    monkeypatch.setattr(DroneVectorEnv, "reset", reset)
    monkeypatch.setattr(policy_evaluation, "MOST_WORLDS", 2)
    task = Hover(episode_s=0.2)
    result = dv.evaluate_policy(hovering_policy, 5, world="low-texture", world_seeds=(7, 9, 4), task=task)
    assert len(result.success) == 5 and flown == [7, 9, 4, 7, 9]


def test_single_episodes_are_in_the_given_worlds(monkeypatch: pytest.MonkeyPatch) -> None:
    flown: list[int] = []
    plain = DroneEnv.reset

    def reset(self: DroneEnv, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        observation, info = plain(self, seed=seed, options=options)
        flown.append(info["randomization"]["world_seed"])
        return observation, info

    monkeypatch.setattr(DroneEnv, "reset", reset)
    monkeypatch.setattr(policy_evaluation, "MOST_WORLDS", 4)
    short: dict[str, Any] = {"task": Navigate(episode_s=0.2), "observations": ("goals", "rotation")}
    result = dv.evaluate_baseline("straight", 5, world="low-texture", world_seeds=(9, 7, 4, 8, 6), **short)
    assert len(result.success) == 5 and flown == [9, 7, 4, 8, 6]


def test_episodes_on_an_estimate_are_flown_one_after_another(hovering_policy: Policy) -> None:
    """With an estimate that does not move, the policy climbs to its goal without an end."""
    run: dict[str, Any] = {"environment": "dronevio/VioHover-v0", "task": VioHover(episode_s=2.0)}
    result = dv.evaluate_policy(hovering_policy, 2, 3, estimator=Standing, world="low-texture", **run)
    assert result.environment == "dronevio/VioHover-v0" and len(result.ends) == 2
    assert (result.duration_s > 0.1).all() and not result.success.any()
    with pytest.raises(ConfigError, match=r"observation 'imu' of shape .* in dronevio/VioHover-v0"):
        dv.evaluate_policy(of_two_samples(hovering_policy), 1, estimator=Standing, **run)


def test_other_rates_keep_the_time_limit(hovering_policy: Policy) -> None:
    fast = replace(hovering_policy, action_rate_hz=100.0)
    result = dv.evaluate_policy(fast, 2, task=Hover(episode_s=1.0))
    np.testing.assert_array_equal(result.duration_s, [1.0, 1.0])


def test_environments_have_to_fit_the_policy(hovering_policy: Policy) -> None:
    with pytest.raises(ConfigError, match="unknown environment 'dronevio/Fly-v0'; expected one of dronevio/Explore-v0"):
        dv.evaluate_policy(hovering_policy, 2, environment="dronevio/Fly-v0")
    with pytest.raises(ConfigError, match="'dronevio/VioHover-v0' without native vectors"):
        policy_envs(hovering_policy, 2, environment="dronevio/VioHover-v0")
    with pytest.raises(ConfigError, match="0 episodes"):
        dv.evaluate_policy(hovering_policy, 0)
    with pytest.raises(ConfigError, match=r"observation 'imu' of shape \(4, 6\) in .*; expected \(2, 6\)"):
        dv.evaluate_policy(of_two_samples(hovering_policy), 2)


def test_command_evaluates(
    hovering_policy: Policy, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    saved = tmp_path / "falling.safetensors"
    dv.save_policy(saved, falling(hovering_policy))
    assert main(["policy", "evaluate", str(saved), "--episodes", "3", "--seed", "5", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["episodes"], document["seed"], document["randomization"]) == (3, 5, "none")
    (row,) = document["policies"]
    assert (row["environment"], row["success_rate"], row["ends"]) == ("dronevio/Hover-v0", 0.0, {"ground": 3})
    assert main(["policy", "evaluate", str(saved), "--episodes", "2", "--randomization", "moderate"]) == 0
    shown = capsys.readouterr().out
    assert "2 episodes, seed 1000000, randomization moderate" in shown and "2 ground" in shown
    flown: dict[str, Any] = {}
    plain = policy_evaluation.evaluate_policy
    monkeypatch.setattr(
        policy_evaluation, "evaluate_policy", lambda *given, **run: flown.update(run) or plain(*given, **run)
    )
    several = ["--episodes", "2", "--world", "low-texture", "--world-seed", "7", "--worlds", "3", "--json"]
    assert main(["policy", "evaluate", str(saved), *several]) == 0
    assert json.loads(capsys.readouterr().out)["worlds"] == 3
    assert list(flown["world_seeds"]) == [7, 8, 9]


def test_command_describes(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["policy", "show", str(saved)]) == 0
    shown = capsys.readouterr().out
    assert "position (3), rotation (3 × 3), velocity (3)" in shown and "15 – 4" in shown
    assert main(["policy", "show", str(saved), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["action"]["mode"] == "rates" and document["network"]["parameters"] == 64


def test_command_exports(saved: Path, capsys: pytest.CaptureFixture[str]) -> None:
    onnx = pytest.importorskip("onnx")
    assert main(["policy", "export-onnx", str(saved)]) == 0
    model = onnx.load(saved.with_suffix(".onnx"))
    assert [one.name for one in model.graph.input] == ["observation"]
    assert main(["policy", "export-onnx", str(saved)]) == 2
    assert "exists already" in capsys.readouterr().err


def test_commands_explain_bad_input(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "bad.safetensors").write_bytes(b"nothing")
    assert main(["policy", "evaluate", str(tmp_path / "bad.safetensors")]) == 2
    assert "bad.safetensors: 7 bytes; expected a policy" in capsys.readouterr().err
    assert main(["policy", "evaluate"]) == 2
    assert "no policy; expected" in capsys.readouterr().err


@pytest.mark.slow
def test_run_flies_a_policy(hovering_policy: Policy, tmp_path: Path, run_command: Callable[..., Any]) -> None:
    """The policy stops the rotors when it takes over, so that the flight is short."""
    dv.save_policy(tmp_path / "falling.safetensors", falling(hovering_policy))
    plan = ["--plan.initial-rest-s", "1.2", "--plan.takeoff-s", "1.2"]
    options = [
        "--policy",
        tmp_path / "falling.safetensors",
        "--fly-on",
        "estimate",
        "--rig",
        "nano",
        "--world",
        "repetitive",
        *plan,
    ]
    out = tmp_path / "run"
    result = run_command(out, "run", *options, "--out", out)
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    policy = report["policy"]
    assert (policy["environment"], policy["success"]) == ("dronevio/Hover-v0", False)
    assert policy["end"] == "ground" and 0.2 < policy["duration_s"] < 1.0 and policy["distance_m"] > 0.8
    assert report["control"]["flown_on"] == "estimate" and report["control"]["reference_rmse_m"] is None
    assert "task:     not accomplished (dronevio/Hover-v0; end: ground)" in result.out
    assert "distance from the goal at the end, flown on the estimate" in result.out
    assert report["configuration"]["policy"]["action"]["mode"] == "rates"
    assert report["configuration"]["scenario"]["name"] == "policy-hover"
    assert report["command"].startswith("dronevio run --scenario=room-v0 --seed=0 --policy")
    assert "Task of dronevio/Hover-v0" in (out / "report.html").read_text(encoding="utf-8")


def test_run_refuses_what_cannot_be_flown(
    saved: Path, hovering_policy: Policy, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    navigate = tmp_path / "navigate.safetensors"
    dv.save_policy(navigate, replace(hovering_policy, environment="dronevio/Navigate-v0"))
    out = tmp_path / "run"
    assert main(["run", "--policy", str(navigate), "--out", str(out)]) == 2
    assert "a policy for dronevio/Navigate-v0; expected one for a task of hover" in capsys.readouterr().err
    assert main(["run", "--policy", str(saved), "--live", "--out", str(out)]) == 2
    assert "--live with --policy" in capsys.readouterr().err
    assert not out.exists()


def test_flights_are_tabulated_by_policy_and_state(script: Callable[[str], Any]) -> None:
    flights = script("policy_flights")

    def result(policy: str, state: str, seed: int, success: bool, *values: Any) -> Any:
        end, duration_s, distance_m, ate_m = values
        return flights.FlightResult(policy, state, seed, success, end, duration_s, distance_m, ate_m)

    results = [
        result("race", "estimate", 0, False, "no take-off", 0.0, None, None),
        result("hover", "truth", 0, True, "time limit", 10.0, 0.01, 0.02),
        result("hover", "truth", 1, True, "time limit", 10.0, 0.03, 0.04),
        result("hover", "estimate", 0, True, "time limit", 10.0, 0.05, 0.02),
        result("hover", "estimate", 1, False, "ground", 2.0, 1.05, 0.04),
    ]
    assert [tuple(row.values()) for row in flights.rows_of(results)] == [
        ("race", "estimate", "1", "0", "–", "–", "–", "1 no take-off"),
        ("hover", "truth", "2", "2", "0.020", "10.00", "0.030", "2 time limit"),
        ("hover", "estimate", "2", "1", "0.550", "10.00", "0.030", "1 time limit, 1 ground"),
    ]
