"""Convolutions in numpy: the first layers of a network that sees an image."""

from collections.abc import Callable
from dataclasses import dataclass
from math import prod

from numpy.lib.stride_tricks import sliding_window_view

from dronevio.models.policies.arrays32 import Array32, PolicyError, require_numbers, require_vector

MOST_CONVOLUTIONS = 8
"""Upper limit of the number of convolutions."""
LARGEST_IMAGE = 65_536
"""Upper limit of the number of values of an image, and of the results of a convolution."""
MOST_PRODUCTS = 2**24
"""Upper limit of the number of values that a convolution multiplies for one output, which are in memory together."""


@dataclass(frozen=True, eq=False)
class Convolution:
    """A convolution without padding, y(m, i, j) = b(m) + Σ W(m, c, k, l) x(c, s i + k, s j + l)."""

    weight: Array32
    """(M, C, K, L) Weights W, by outputs, inputs, rows and columns."""
    bias: Array32
    """(M,) Biases b of the outputs."""
    stride: int = 1
    """Number of pixels s from one result to the next, along rows and columns."""

    def __call__(self, image: Array32) -> Array32:
        """Return the results (n, M, H', W') for images (n, C, H, W)."""
        outputs, _, height, width = self.weight.shape
        windows = sliding_window_view(image, (height, width), axis=(2, 3))[:, :, :: self.stride, :: self.stride]
        n, _, rows, columns = windows.shape[:4]
        flat = windows.transpose(0, 2, 3, 1, 4, 5).reshape(n * rows * columns, -1)
        results = flat @ self.weight.reshape(outputs, -1).T + self.bias
        return results.reshape(n, rows, columns, outputs).transpose(0, 3, 1, 2)

    def size_of(self, rows: int, columns: int) -> tuple[int, int]:
        """Return the numbers of rows and columns of the results for an image."""
        height, width = self.weight.shape[2:]
        return (rows - height) // self.stride + 1, (columns - width) // self.stride + 1


@dataclass(frozen=True, eq=False)
class Encoder:
    """Convolutions of an image, one after another, whose results become the inputs of linear layers."""

    image: tuple[int, int, int]
    """Height, width and number of channels of the image, as it is observed."""
    convolutions: tuple[Convolution, ...]
    """The convolutions in order."""

    def __post_init__(self) -> None:
        """Check shapes and values.

        Raises:
            PolicyError: The shapes do not fit together, there are too many values, or one is not finite.
        """
        if len(self.image) != 3 or min(self.image) < 1 or self.inputs > LARGEST_IMAGE:
            found = f"network.image: {self.image}"
            raise PolicyError(found, f"height, width and channels, with a product up to {LARGEST_IMAGE}")
        if not 1 <= len(self.convolutions) <= MOST_CONVOLUTIONS:
            raise PolicyError(f"{len(self.convolutions)} convolutions", f"1 to {MOST_CONVOLUTIONS}")
        rows, columns, channels = self.image
        for index, one in enumerate(self.convolutions):
            name, shape = f"convolutions.{index}.weight", one.weight.shape
            if len(shape) != 4 or min(shape) < 1 or shape[1] != channels:
                raise PolicyError(f"{name}: shape {shape}", f"outputs × {channels} × rows × columns")
            if not 1 <= one.stride <= LARGEST_IMAGE:
                raise PolicyError(f"network.strides.{index}: {one.stride}", "1 or more")
            require_numbers(name, one.weight)
            require_vector(f"convolutions.{index}.bias", one.bias, shape[0])
            if shape[2] > rows or shape[3] > columns:
                raise PolicyError(f"{name}: shape {shape}", f"at most the {rows} × {columns} pixels of its input")
            rows, columns = one.size_of(rows, columns)
            channels = shape[0]
            if rows * columns * channels > LARGEST_IMAGE:
                raise PolicyError(f"{name}: {rows} × {columns} × {channels} results", f"up to {LARGEST_IMAGE}")
            if rows * columns * prod(shape[1:]) > MOST_PRODUCTS:
                raise PolicyError(
                    f"{name}: shape {shape} for {rows} × {columns} results", f"up to {MOST_PRODUCTS} products"
                )

    @property
    def inputs(self) -> int:
        """Number of values of the image."""
        return prod(self.image)

    @property
    def outputs(self) -> int:
        """Number of results of the last convolution."""
        rows, columns, _ = self.image
        for one in self.convolutions:
            rows, columns = one.size_of(rows, columns)
        return rows * columns * len(self.convolutions[-1].weight)

    def __call__(self, values: Array32, activate: Callable[[Array32], Array32]) -> Array32:
        """Return the results (n, F), by outputs, rows and columns, of flat images (n, H · W · C).

        Args:
            values: Images, by rows, columns and channels.
            activate: Function after each convolution.
        """
        image = values.reshape(-1, *self.image).transpose(0, 3, 1, 2)
        for one in self.convolutions:
            image = activate(one(image))
        return image.reshape(len(values), -1)
