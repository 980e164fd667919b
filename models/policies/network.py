"""Networks in numpy: scaling of the inputs, an encoder of an image, linear layers, and squashing of the outputs."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from dronevio.models.policies.arrays32 import LARGEST_NUMBER, Array32, PolicyError, require_numbers, require_vector
from dronevio.models.policies.convolutions import Encoder

MOST_LAYERS = 16
"""Upper limit of the number of layers."""
WIDEST = 4096
"""Upper limit of the number of inputs and of outputs of a layer."""

ACTIVATIONS: dict[str, Callable[[Array32], Array32]] = {
    "tanh": np.tanh,
    "relu": lambda x: np.maximum(x, np.float32(0.0)),
    "elu": lambda x: np.where(x > 0.0, x, np.expm1(np.minimum(x, np.float32(0.0)))),
}
"""Functions between the layers by name."""
SQUASHINGS: dict[str, Callable[[Array32], Array32]] = {
    "clip": lambda x: np.clip(x, np.float32(-1.0), np.float32(1.0)),
    "tanh": np.tanh,
}
"""Functions from the outputs of the last layer to values in [−1, 1] by name."""


@dataclass(frozen=True, eq=False)
class Scaling:
    """Affine scaling of inputs, (x − mean) / scale, clipped to ± limit."""

    mean: Array32
    """(N,) Values that become 0."""
    scale: Array32
    """(N,) Positive differences from the mean that become 1."""
    limit: float | None = None
    """Largest magnitude of a scaled value; None without a limit."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            PolicyError: The arrays differ in shape, or a value is not possible.
        """
        require_vector("observation.mean", self.mean, self.mean.size)
        require_vector("observation.scale", self.scale, self.mean.size)
        if not (self.scale > 0.0).all():
            raise PolicyError(f"observation.scale: {self.scale.min():g}", "positive numbers")
        if self.limit is not None and not 0.0 < self.limit <= LARGEST_NUMBER:
            raise PolicyError(f"observation_limit: {self.limit:g}", f"a positive number up to {LARGEST_NUMBER:g}")

    @classmethod
    def identity(cls, size: int) -> "Scaling":
        """Return a scaling that does not change N inputs."""
        return cls(np.zeros(size, np.float32), np.ones(size, np.float32))

    @classmethod
    def of_statistics(
        cls, mean: npt.ArrayLike, variance: npt.ArrayLike, epsilon: float = 1e-8, limit: float | None = None
    ) -> "Scaling":
        """Return the scaling to zero mean and unit variance.

        Args:
            mean: (N,) Means of the inputs.
            variance: (N,) Variances of the inputs.
            epsilon: Constant that is added to the variances.
            limit: Largest magnitude of a scaled value; None without a limit.

        Raises:
            PolicyError: A value is not possible.
        """
        scale = np.sqrt(np.asarray(variance, np.float64) + epsilon)
        return cls(np.asarray(mean, np.float32), scale.astype(np.float32), limit)

    def apply(self, values: Array32) -> Array32:
        """Return scaled inputs (n, N)."""
        scaled = (values - self.mean) / self.scale
        return scaled if self.limit is None else np.clip(scaled, np.float32(-self.limit), np.float32(self.limit))


@dataclass(frozen=True, eq=False)
class Layer:
    """A linear layer, y = W x + b."""

    weight: Array32
    """(M, N) Weights W, by rows of outputs."""
    bias: Array32
    """(M,) Biases b of the outputs."""


@dataclass(frozen=True, eq=False)
class Network:
    """A multilayer perceptron with one activation and outputs in [−1, 1], after an encoder if it sees an image."""

    layers: tuple[Layer, ...]
    """The linear layers, from the inputs to the outputs."""
    activation: str
    """Function after each layer but the last, and after each convolution: ``tanh``, ``relu`` or ``elu``."""
    squashing: str = "clip"
    """Function after the last layer: ``clip`` to [−1, 1], or ``tanh``."""
    encoder: Encoder | None = None
    """Convolutions of an image, which is the first of the inputs; their results replace it as inputs of the layers."""

    def __post_init__(self) -> None:
        """Check names, shapes and values.

        Raises:
            PolicyError: A name is unknown, the shapes do not fit together, or a value is not finite.
        """
        if self.activation not in ACTIVATIONS:
            raise PolicyError(f"activation: {self.activation!r}", f"one of {', '.join(ACTIVATIONS)}")
        if self.squashing not in SQUASHINGS:
            raise PolicyError(f"squashing: {self.squashing!r}", f"one of {', '.join(SQUASHINGS)}")
        if not 1 <= len(self.layers) <= MOST_LAYERS:
            raise PolicyError(f"{len(self.layers)} layers", f"1 to {MOST_LAYERS} layers")
        for index, layer in enumerate(self.layers):
            name, weight = f"layers.{index}.weight", layer.weight
            if weight.ndim != 2 or not 1 <= min(weight.shape) <= max(weight.shape) <= WIDEST:
                raise PolicyError(f"{name}: shape {weight.shape}", f"a matrix of 1 to {WIDEST} rows and columns")
            if index > 0 and weight.shape[1] != len(self.layers[index - 1].weight):
                inputs = len(self.layers[index - 1].weight)
                raise PolicyError(f"{name}: shape {weight.shape}", f"{inputs} columns, as the layer before has rows")
            if index == 0 and self.encoder is not None and weight.shape[1] < self.encoder.outputs:
                expected = f"{self.encoder.outputs} columns or more, as the convolutions have results"
                raise PolicyError(f"{name}: shape {weight.shape}", expected)
            require_numbers(name, weight)
            require_vector(f"layers.{index}.bias", layer.bias, len(weight))

    @property
    def inputs(self) -> int:
        """Number of inputs."""
        seen = 0 if self.encoder is None else self.encoder.inputs - self.encoder.outputs
        return seen + int(self.layers[0].weight.shape[1])

    @property
    def outputs(self) -> int:
        """Number of outputs."""
        return len(self.layers[-1].weight)

    def __call__(self, values: Array32) -> Array32:
        """Return outputs (n, M) of scaled inputs (n, N)."""
        activate = ACTIVATIONS[self.activation]
        if self.encoder is not None:
            image, others = np.split(values, [self.encoder.inputs], axis=1)
            values = np.concatenate([self.encoder(image, activate), others], axis=1)
        for layer in self.layers[:-1]:
            values = activate(values @ layer.weight.T + layer.bias)
        last = self.layers[-1]
        return SQUASHINGS[self.squashing](values @ last.weight.T + last.bias)
