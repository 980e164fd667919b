"""Policies that see: convolutions against scipy, files and their damage, and ONNX."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from safetensors.numpy import load_file, save
from scipy.signal import correlate

from dronevio.models.actions import ActionLimits
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.policies import (
    Convolution,
    Encoder,
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

IMAGE = 9, 11, 2


def drawn(*shape: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng((seed, *shape)).normal(0.0, 0.4, shape).astype(np.float32)


def seeing(activation: str = "relu") -> Policy:
    """A random policy of an image and three other numbers."""
    first = Convolution(drawn(4, 2, 3, 2), drawn(4), 2)  # of 9 × 11 pixels, 4 × 5 results
    second = Convolution(drawn(3, 4, 2, 2), drawn(3))  # 3 × 4 × 3 results
    layers = Layer(drawn(6, 36 + 3), drawn(6)), Layer(drawn(4, 6), drawn(4))
    size = 9 * 11 * 2 + 3
    return Policy(
        environment="dronevio/Navigate-v0",
        vehicle="research",
        inputs=(NamedShape("depth", IMAGE), NamedShape("velocity", (3,))),
        scaling=Scaling(drawn(size), np.exp(drawn(size, seed=1)), 2.0),
        network=Network(layers, activation, "tanh", Encoder(IMAGE, (first, second))),
        action_mode="velocity",
        action_limits=ActionLimits(),
        action_rate_hz=10.0,
        imu_rate_hz=200.0,
        provenance=Provenance("DAgger", 10, 0),
    )


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    path = tmp_path / "seeing.safetensors"
    save_policy(path, seeing())
    return path


def rewritten(path: Path, arrays: dict[str, Any], **network: Any) -> Path:
    """Write the file again with changed arrays, of which None removes one, and changed fields of the network."""
    document = json.loads(description(load_policy(path)))
    document["network"] |= network
    changed = {name: array for name, array in {**load_file(path), **arrays}.items() if array is not None}
    path.write_bytes(save(changed, {METADATA_KEY: json.dumps(document)}))
    return path


@pytest.mark.parametrize("stride", [1, 2, 3])
def test_results_are_correlations(stride: int) -> None:
    one, images = Convolution(drawn(4, 2, 3, 2), drawn(4), stride), drawn(5, 2, 9, 11)
    results = one(images)
    for n in range(5):
        for m in range(4):
            # over all channels, which are as many in the kernel
            whole = correlate(images[n], one.weight[m], mode="valid")[0] + one.bias[m]
            np.testing.assert_allclose(results[n, m], whole[::stride, ::stride], atol=1e-5)
    assert results.shape[2:] == one.size_of(9, 11)


def test_the_image_is_by_rows_columns_and_channels() -> None:
    """A kernel of one pixel that takes the second channel leaves it in the order of rows and columns."""
    pick = Convolution(np.array([[[[0.0]], [[1.0]]]], np.float32), np.zeros(1, np.float32))
    image = np.arange(24, dtype=np.float32).reshape(1, 3, 4, 2)
    features = Encoder((3, 4, 2), (pick,))(image.reshape(1, -1), lambda x: x)
    np.testing.assert_array_equal(features[0], np.arange(1, 24, 2))


def test_other_observations_follow_the_results() -> None:
    policy = seeing()
    network, encoder = policy.network, policy.network.encoder
    assert encoder is not None and (network.inputs, encoder.outputs) == (201, 36)
    observation = {"depth": drawn(6, *IMAGE), "velocity": drawn(6, 3)}
    flat = policy.scaling.apply(np.concatenate([observation["depth"].reshape(6, -1), observation["velocity"]], axis=1))
    relu = np.maximum
    features = np.hstack([encoder(flat[:, :198], lambda x: relu(x, np.float32(0.0))), flat[:, 198:]])
    hidden = relu(features @ network.layers[0].weight.T + network.layers[0].bias, 0.0)
    expected = np.tanh(hidden @ network.layers[1].weight.T + network.layers[1].bias)
    np.testing.assert_allclose(policy.action(observation), expected, atol=1e-6)


@pytest.mark.parametrize("activation", ["tanh", "relu", "elu"])
def test_a_file_gives_the_same_policy(tmp_path: Path, activation: str) -> None:
    written = seeing(activation)
    save_policy(tmp_path / "one.safetensors", written)
    read = load_policy(tmp_path / "one.safetensors")
    assert description(read) == description(written) and json.loads(description(read))["version"] == 2
    values = drawn(3, 201)
    np.testing.assert_array_equal(read.action(values), written.action(values))


@pytest.mark.parametrize("activation", ["tanh", "relu", "elu"])
def test_onnx_gives_the_same_actions(tmp_path: Path, activation: str) -> None:
    reference = pytest.importorskip("onnx.reference")
    policy, values = seeing(activation), drawn(7, 201)
    write_onnx(tmp_path / "policy.onnx", policy)
    (actions,) = reference.ReferenceEvaluator(str(tmp_path / "policy.onnx")).run(None, {INPUT: values})
    np.testing.assert_allclose(actions, policy.action(values), atol=2e-6)


@pytest.mark.parametrize(
    ("arrays", "network", "message"),
    [
        ({}, {"strides": [2]}, r"network.strides: \[2\]; expected 2 numbers"),
        ({}, {"strides": [2, 0]}, "network.strides.1: 0; expected 1 or more"),
        ({}, {"strides": [2, "1"]}, "network.strides.1: '1'; expected an integer"),
        ({}, {"image": [9, 22]}, r"network.image: \[9, 22\]; expected height, width and channels"),
        ({}, {"image": [11, 9, 2]}, r"network.image: \(11, 9, 2\); expected the shape of the first observation"),
        ({}, {"image": [9, 11, 10**9]}, "with a product up to 65536"),
        ({}, {"padding": 1}, "unknown field network.padding"),
        ({"convolutions.0.weight": np.zeros((4, 3, 3, 2), np.float32)}, {}, "expected outputs × 2 × rows × columns"),
        ({"convolutions.1.weight": np.zeros((3, 4, 9, 2), np.float32)}, {}, "at most the 4 × 5 pixels"),
        ({"convolutions.1.bias": np.zeros(4, np.float32)}, {}, r"convolutions.1.bias: shape \(4,\)"),
        ({"convolutions.1.bias": np.full(3, np.inf, np.float32)}, {}, "convolutions.1.bias: the number inf"),
        ({"convolutions.1.bias": None}, {}, "no array convolutions.1.bias"),
        ({"convolutions.2.bias": np.zeros(3, np.float32)}, {}, "no array convolutions.2.weight"),
        ({"convolutions.0.weight": np.zeros((4, 2, 3, 2, 1), np.float32)}, {}, "at most 4 dimensions"),
        ({"layers.0.weight": np.zeros((6, 35), np.float32)}, {}, "expected 36 columns or more"),
        ({"layers.0.weight": np.zeros((6, 38), np.float32)}, {}, "layers.0.weight: 38 columns; expected 39"),
    ],
)
def test_wrong_files_are_refused(saved: Path, arrays: dict[str, Any], network: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_policy(rewritten(saved, arrays, **network))


def test_convolutions_belong_to_the_second_version(saved: Path) -> None:
    document = json.loads(description(seeing())) | {"version": 1}
    del document["network"]["image"], document["network"]["strides"]
    saved.write_bytes(save(load_file(saved), {METADATA_KEY: json.dumps(document)}))
    with pytest.raises(InputError, match="version: 1; expected 2, with convolutions"):
        load_policy(saved)


def test_results_are_bounded() -> None:
    """Each convolution is possible by itself, but has more results than a network may have."""
    wide = Convolution(np.zeros((300, 1, 1, 1), np.float32), np.zeros(300, np.float32))
    with pytest.raises(ConfigError, match="64 × 64 × 300 results; expected up to 65536"):
        Encoder((64, 64, 1), (wide,))
    large = Convolution(np.zeros((1, 1, 128, 128), np.float32), np.zeros(1, np.float32))
    with pytest.raises(ConfigError, match="for 129 × 129 results; expected up to 16777216 products"):
        Encoder((256, 256, 1), (large,))
    with pytest.raises(ConfigError, match="0 convolutions"):
        Encoder((64, 64, 1), ())
    with pytest.raises(ConfigError, match=r"network\.image"):
        replace(seeing(), inputs=(NamedShape("velocity", (3,)), NamedShape("depth", IMAGE)))


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.data())
def test_damaged_files_are_read_or_refused(saved: Path, data: st.DataObject) -> None:
    original = saved.with_name("original")
    if not original.exists():
        original.write_bytes(saved.read_bytes())
    content = bytearray(original.read_bytes())
    start = data.draw(st.integers(0, 2000))
    content[start : start + data.draw(st.integers(0, 12))] = data.draw(st.binary(max_size=12))
    saved.write_bytes(bytes(content))
    try:
        read = load_policy(saved)
    except InputError:
        return
    assert np.isfinite(read.action(np.zeros((1, read.network.inputs), np.float32))).all()
