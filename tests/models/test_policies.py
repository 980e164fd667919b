"""Policies: the network in numpy, files, their checks against damage, and ONNX."""

import itertools
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file, save

import dronevio as dv
from dronevio.models.actions import ActionLimits
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.extras import install_command
from dronevio.models.policies import (
    Layer,
    NamedShape,
    Network,
    Policy,
    Provenance,
    Scaling,
    load_policy,
    save_policy,
    write_onnx,
)
from dronevio.models.policies.onnx_file import INPUT
from dronevio.models.policies.policy_file import METADATA_KEY, description


def policy_with(activation: str = "tanh", squashing: str = "clip", limit: float | None = 3.0) -> Policy:
    """A random policy with two observations and two layers."""
    rng = np.random.default_rng(5)
    sizes = (12, 7, 4)
    layers = tuple(
        Layer(rng.normal(0.0, 0.5, (m, n)).astype(np.float32), rng.normal(0.0, 0.5, m).astype(np.float32))
        for n, m in itertools.pairwise(sizes)
    )
    scaling = Scaling(rng.normal(size=12).astype(np.float32), rng.uniform(0.5, 2.0, 12).astype(np.float32), limit)
    return Policy(
        environment="dronevio/Hover-v0",
        vehicle="research",
        inputs=(NamedShape("position", (3,)), NamedShape("rotation", (3, 3))),
        scaling=scaling,
        network=Network(layers, activation, squashing),
        action_mode="rates",
        action_limits=ActionLimits(rate_rad_s=5.0),
        action_rate_hz=50.0,
        imu_rate_hz=200.0,
        provenance=Provenance("PPO", 500_000, 3, {"numpy": np.__version__}),
    )


@pytest.fixture
def policy() -> Policy:
    return policy_with()


@pytest.fixture
def saved(policy: Policy, tmp_path: Path) -> Path:
    path = tmp_path / "hover.safetensors"
    save_policy(path, policy)
    return path


def rewritten(path: Path, change: Any = None, arrays: dict[str, np.ndarray] | None = None) -> Path:
    """Write the file again with a changed description, which a function may modify, and changed arrays."""
    document = json.loads(description(policy_with()))
    if change is not None:
        document = change(document) or document
    path.write_bytes(save({**load_file(path), **(arrays or {})}, {METADATA_KEY: json.dumps(document)}))
    return path


# --- evaluation


def test_actions_by_hand() -> None:
    scaling = Scaling(np.array([1.0, 0.0, 0.0], np.float32), np.array([2.0, 1.0, 1.0], np.float32), 1.5)
    first = Layer(np.array([[1.0, 1.0, 0.0], [0.0, 0.0, -1.0]], np.float32), np.array([0.5, 0.0], np.float32))
    last = Layer(np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.1, 0.1]], np.float32), np.zeros(4, np.float32))
    one = replace(
        policy_with(), inputs=(NamedShape("position", (3,)),), scaling=scaling, network=Network((first, last), "relu")
    )
    # (5 − 1) / 2 = 2 is limited to 1.5; 1.5 − 1 + 0.5 = 1 and relu(−0.25) = 0
    np.testing.assert_allclose(one.action({"position": [[5.0, -1.0, 0.25]]}), [[1.0, 0.0, -1.0, 0.1]], atol=1e-7)
    elu = replace(one, network=Network((first, last), "elu", "tanh"))
    expected = np.tanh([[1.0, np.expm1(-0.25), -1.0, 0.1 + 0.1 * np.expm1(-0.25)]])
    np.testing.assert_allclose(elu.action({"position": [[5.0, -1.0, 0.25]]}), expected, atol=1e-6)


def test_actions_are_batched(policy: Policy) -> None:
    rng = np.random.default_rng(1)
    observation = {name: rng.normal(size=(6, *shape)) for name, shape in (("rotation", (3, 3)), ("position", (3,)))}
    actions = policy.action({**observation, "other": []})
    assert actions.shape == (6, 4) and actions.dtype == np.float32 and (np.abs(actions) <= 1.0).all()
    flat = np.concatenate([observation["position"], observation["rotation"].reshape(6, 9)], axis=1)
    np.testing.assert_array_equal(policy.action(flat), actions)
    np.testing.assert_allclose(policy.action(flat[2:3]), actions[2:3], atol=1e-6)


@pytest.mark.parametrize(
    ("observation", "message"),
    [
        ({"position": np.zeros((1, 3))}, "expected also 'rotation'"),
        ({"position": np.zeros((1, 2)), "rotation": np.zeros((1, 3, 3))}, r"'position' of shape \(1, 2\)"),
        (np.zeros((1, 11)), r"shape \(1, 11\); expected \(n, 12\)"),
    ],
)
def test_wrong_observations_are_errors(policy: Policy, observation: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        policy.action(observation)


# --- files


@pytest.mark.parametrize("limit", [None, 10.0])
def test_a_file_gives_the_same_policy(tmp_path: Path, limit: float | None) -> None:
    written = policy_with("elu", "tanh", limit)
    save_policy(tmp_path / "one.safetensors", written)
    read = dv.load_policy(tmp_path / "one.safetensors")
    assert description(read) == description(written)
    values = np.random.default_rng(2).normal(size=(9, 12))
    np.testing.assert_array_equal(read.action(values), written.action(values))


def set_in(path: str, value: Any) -> Any:
    """Return a function that sets a field of a description by its dotted name."""

    def change(document: Any) -> None:
        *parents, last = path.split(".")
        for name in parents:
            document = document[int(name) if name.isdigit() else name]
        if value is KeyError:
            del document[last]
        else:
            document[last] = value

    return change


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("version", 3, "version: 3; expected up to 2"),
        ("version", 2, "no field network.strides"),
        ("network.image", [1, 1, 1], "unknown field network.image"),
        ("version", True, "version: True; expected an integer"),
        ("environment", "../etc", "environment: '../etc'; expected an id"),
        ("environment", KeyError, "no field environment; expected environment: a text"),
        ("vehicle", 3, "vehicle: 3; expected a text"),
        ("extra", 1, "unknown field extra; expected only version"),
        ("observations", [], "observation.mean: shape"),
        ("observations", {}, "expected a list"),
        ("observations.0.name", "Position!", "name of an observation"),
        ("observations.0.name", "rotation", "rotation, rotation; expected each name once"),
        ("observations.0.shape", [2], r"observation.mean: shape \(12,\); expected shape \(11,\)"),
        ("observations.0.shape", [-3], r"position: shape \(-3,\)"),
        ("observations.0.shape", [10**9, 10**9], "product up to 65536"),
        ("observations.1.shape", ["3"], r"observations.1.shape.0: '3'; expected an integer"),
        ("observation_limit", KeyError, "no field observation_limit"),
        ("observation_limit", 0.0, "observation_limit: 0"),
        ("action.mode", "thrust", "action.mode: 'thrust'; expected one of rotors"),
        ("action.rate_hz", 1e300, "action.rate_hz: 1e.300; expected a finite number"),
        ("action.rate_hz", 500.0, "not above that of the IMU"),
        ("action.limits.tilt_rad", -1.0, "action.limits.tilt_rad: -1.0; expected a positive number"),
        ("action.limits.tilt_rad", KeyError, "no field action.limits.tilt_rad"),
        ("action.limits.speed", 1.0, "unknown field action.limits.speed"),
        ("action.limits", None, "action.limits: None; expected an object"),
        ("network.activation", "exec", "activation: 'exec'; expected one of tanh, relu, elu"),
        ("network.squashing", "none", "squashing: 'none'"),
        ("provenance.samples", -1, "provenance.samples: -1"),
        ("provenance.versions.numpy", 2.0, "provenance.versions.numpy: 2.0"),
        ("provenance.algorithm", "a\nb", "provenance.algorithm"),
    ],
)
def test_wrong_fields_are_named(saved: Path, field: str, value: Any, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        load_policy(rewritten(saved, set_in(field, value)))
    assert str(caught.value).startswith(f"{saved}: ")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"layers.0.weight": np.zeros((7, 11), np.float32)}, r"layers.0.weight: 11 columns; expected 12"),
        ({"layers.1.weight": np.zeros((4, 6), np.float32)}, r"layers.1.weight: shape \(4, 6\); expected 7 columns"),
        ({"layers.1.bias": np.zeros(3, np.float32)}, r"layers.1.bias: shape \(3,\); expected shape \(4,\)"),
        ({"layers.0.bias": np.zeros(7, np.float64)}, "layers.0.bias: type F64"),
        ({"layers.0.bias": np.full(7, np.nan, np.float32)}, "layers.0.bias: the number nan"),
        (
            {"layers.0.weight": np.zeros((7, 12, 1), np.float32)},
            r"layers.0.weight: shape \(7, 12, 1\); expected a matrix",
        ),
        ({"observation.scale": np.zeros(12, np.float32)}, "observation.scale: 0; expected positive"),
        ({"observation.mean": np.zeros((0,), np.float32)}, "observation.mean"),
        ({"extra": np.zeros(1, np.float32), "more": np.zeros(1, np.float32)}, "an array 'extra'"),
        ({f"x{i}": np.zeros(1, np.float32) for i in range(40)}, "an array 'x0'"),
    ],
)
def test_wrong_arrays_are_named(saved: Path, arrays: dict[str, np.ndarray], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_policy(rewritten(saved, arrays=arrays))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "0 bytes"),
        (b"\x80\x04pickled bytes", "a header of"),
        (b"\xff" * 100, "a header of"),
        (b"\x02\x00\x00\x00\x00\x00\x00\x00{}", "no dronevio_policy in the metadata"),
        (save({"a": np.zeros(3, np.float32)}, {METADATA_KEY: "{}"}), "0 layers; expected 1 to 16 layers"),
    ],
)
def test_files_of_other_kinds_are_refused(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "other.safetensors"
    path.write_bytes(content)
    with pytest.raises(InputError, match=message):
        load_policy(path)


def test_what_is_no_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        load_policy(tmp_path / "missing.safetensors")
    with pytest.raises(InputError, match="it is no file"):
        load_policy(tmp_path)


@pytest.mark.parametrize("text", ["[1]", "{", "[" * 10_000, '{"version": 1' + "0" * 5000 + "}", '{"version": NaN}'])
def test_wrong_descriptions_are_refused(saved: Path, text: str) -> None:
    saved.write_bytes(save(load_file(saved), {METADATA_KEY: text}))
    with pytest.raises(InputError):
        load_policy(saved)


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_files_are_read_or_refused(saved: Path, data: st.DataObject) -> None:
    original = saved.with_name("original")
    if not original.exists():
        original.write_bytes(saved.read_bytes())
    content = bytearray(original.read_bytes())
    start = data.draw(st.integers(0, len(content)) | st.integers(0, 1500))
    inserted = data.draw(st.binary(max_size=12))
    content[start : start + data.draw(st.integers(0, 12))] = inserted
    content = content[: data.draw(st.just(len(content)) | st.integers(0, len(content)))]
    saved.write_bytes(bytes(content))
    try:
        read = load_policy(saved)
    except InputError:
        return
    assert np.isfinite(read.action(np.zeros((1, read.network.inputs), np.float32))).all()


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3),
    max_leaves=5,
)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.sampled_from(
        ["version", "environment", "observations", "observations.0.shape", "observation_limit", "action.limits"]
        + ["action.rate_hz", "imu_rate_hz", "network", "network.activation", "provenance", "provenance.versions"]
    ),
    json_values,
)
def test_any_value_of_a_field_is_read_or_refused(saved: Path, field: str, value: Any) -> None:
    try:
        read = load_policy(rewritten(saved, set_in(field, value)))
    except InputError:
        return
    assert np.isfinite(read.action(np.zeros((1, 12), np.float32))).all()


def test_a_policy_of_wrong_parts_cannot_be_made(policy: Policy) -> None:
    with pytest.raises(ConfigError, match="environment"):
        replace(policy, environment="Hover")
    with pytest.raises(ConfigError, match="float32"):
        Scaling(np.zeros(3), np.ones(3))  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match="0 layers"):
        Network((), "tanh")


# --- ONNX


@pytest.mark.parametrize(
    ("activation", "squashing", "limit"), [("tanh", "clip", 3.0), ("relu", "tanh", None), ("elu", "clip", None)]
)
def test_onnx_gives_the_same_actions(tmp_path: Path, activation: str, squashing: str, limit: float | None) -> None:
    reference = pytest.importorskip("onnx.reference")
    policy = policy_with(activation, squashing, limit)
    write_onnx(tmp_path / "policy.onnx", policy)
    values = np.random.default_rng(3).normal(0.0, 3.0, (20, 12)).astype(np.float32)
    (actions,) = reference.ReferenceEvaluator(str(tmp_path / "policy.onnx")).run(None, {INPUT: values})
    np.testing.assert_allclose(actions, policy.action(values), atol=2e-6)


def test_export_without_onnx_names_the_package(policy: Policy, tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.setitem(__import__("sys").modules, "onnx", None)
    with pytest.raises(ConfigError, match=re.escape(install_command("onnx"))):
        write_onnx(tmp_path / "policy.onnx", policy)
