"""The trainings of examples/rl: their settings, their evaluation, the committed policies, and a few steps of PPO."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import dronevio as dv

FOLDER = Path(__file__).resolve().parents[2] / "examples" / "rl"

pytestmark = pytest.mark.skipif(not FOLDER.is_dir(), reason="the examples are in the repository, not in the package")


def test_all_trainings_have_environments(example: Any) -> None:
    trainings = example("trainings")
    for training in trainings.TRAININGS.values():
        assert training.num_envs * training.rollout_steps % training.minibatch == 0
        envs = trainings.training_envs(training)
        observations, _ = envs.reset(seed=0)
        assert observations.shape == (training.num_envs, *envs.single_observation_space.shape)
        assert envs.spec.id == training.environment
        envs.close()


def test_the_curve_has_means_of_ended_episodes(example: Any) -> None:
    progress = example("progress").Progress(2, 60)
    final = {"success": np.array([True, False]), "distance_m": np.array([0.2, 9.0])}
    progress.add(np.array([1.0, 5.0]), np.array([False, False]), {})
    progress.report()
    progress.add(np.array([2.0, 5.0]), np.array([True, False]), {"final_info": final})
    progress.report()
    progress.report()
    (report,) = progress.reports
    assert (report.samples, report.episodes, report.mean_return, report.mean_length) == (4, 1, 3.0, 2.0)
    assert (report.success_rate, report.error_m) == (1.0, 0.2)


POLICIES = {"hover": (20, 1.0), "hover-imu": (20, 1.0), "waypoints": (20, 0.9), "race": (4, 0.75)}
"""Number of episodes of each committed policy, and the smallest share of them that succeeds."""


@pytest.mark.parametrize("name", POLICIES)
@pytest.mark.slow
def test_committed_policies_succeed(example: Any, name: str) -> None:
    episodes, share = POLICIES[name]
    trainings = example("trainings")
    policy = dv.load_policy(FOLDER / "policies" / f"{name}.safetensors")
    assert policy.environment == trainings.TRAININGS[name].environment
    result = trainings.evaluate(policy, trainings.TRAININGS[name], episodes)
    assert result.success.mean() >= share


def trained(example: Any, module: str, folder: Path) -> dict[str, Any]:
    """Return the result of a short training, whose policy can be loaded."""
    trainer = example(module)
    trainer.main(trainer.TrainCommand("hover", samples=16_000, out=folder))
    assert dv.load_policy(folder / "policy.safetensors").provenance.samples == 16_384
    result: dict[str, Any] = json.loads((folder / "result.json").read_text(encoding="utf-8"))
    return result


@pytest.mark.parametrize("module", ["ppo", "train_sb3"])
def test_a_short_training_writes_its_results(example: Any, module: str, tmp_path: Path) -> None:
    pytest.importorskip("torch")
    if module == "train_sb3":
        pytest.importorskip("stable_baselines3")
    result = trained(example, module, tmp_path)
    assert result["samples"] == 16_384
    assert result["curve"]["samples"] == "8192 16384"
    assert result["evaluation"]["episodes"] == 100


def test_the_guide_shows_the_first_training() -> None:
    """Page and file are the same script, of at most 20 lines."""
    script = (FOLDER / "first_policy.py").read_text(encoding="utf-8").partition('"""\n\n')[2]
    page = (FOLDER.parents[1] / "docs" / "rl.md").read_text(encoding="utf-8")
    assert f"```python\n{script}```" in page and len(script.splitlines()) <= 20


def test_the_first_training_begins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One rollout and one update, which takes ten seconds."""
    pytest.importorskip("stable_baselines3")
    monkeypatch.chdir(tmp_path)
    script = (FOLDER / "first_policy.py").read_text(encoding="utf-8")
    assert "learn(500_000)" in script and "episodes=200" in script
    exec(compile(script.replace("500_000", "1").replace("episodes=200", "episodes=2"), "first_policy.py", "exec"), {})
    assert dv.load_policy("hover.safetensors").provenance.samples == 16 * 2048


@pytest.mark.parametrize("envs", [1, 2])
def test_default_trainings_write_their_curves(example: Any, envs: int, tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3")
    module = example("default_ppo")
    command = module.DefaultCommand("hover", envs=envs, samples=1, every=1000, seeds=(3,), results=tmp_path)
    module.main(command)
    result = json.loads((tmp_path / f"default-ppo-hover-{envs}-3.json").read_text(encoding="utf-8"))
    assert result["curve"]["samples"] == str(2048 * envs) and float(result["curve"]["success_rate"]) <= 0.5
    module.main(module.DefaultCommand(results=tmp_path, draw=tmp_path / "curve.svg"))
    assert "<svg" in (tmp_path / "curve.svg").read_text(encoding="utf-8")
