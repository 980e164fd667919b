"""Arrays of policies: float32 of limited magnitude, and the error about a part of a policy."""

import numpy as np
import numpy.typing as npt

from dronevio.models.errors import ConfigError

Array32 = npt.NDArray[np.float32]

LARGEST_NUMBER = 1e6
"""Upper limit of the magnitude of weights, biases and scalings, so that sums of products do not overflow."""


class PolicyError(ConfigError):
    """A part of a policy is invalid."""

    def __init__(self, found: str, expected: str) -> None:
        """Compose the message ``FOUND; expected EXPECTED``.

        Args:
            found: Name of the part, and what was found.
            expected: Description of what was expected.
        """
        self.found, self.expected = found, expected
        super().__init__(f"{found}; expected {expected}")


def require_vector(name: str, values: Array32, size: int) -> None:
    """Raise PolicyError unless an array is a vector of a size with finite float32 of limited magnitude."""
    if values.shape != (size,) or size < 1:
        raise PolicyError(f"{name}: shape {values.shape}", f"shape ({max(size, 1)},)")
    require_numbers(name, values)


def require_numbers(name: str, values: Array32) -> None:
    """Raise PolicyError unless all values of an array are finite float32 of limited magnitude."""
    if values.dtype != np.float32:
        raise PolicyError(f"{name}: {values.dtype}", "float32")
    wrong = values[~(np.abs(values) <= LARGEST_NUMBER)]
    if wrong.size:
        raise PolicyError(f"{name}: the number {wrong[0]:g}", f"numbers up to {LARGEST_NUMBER:g}")
