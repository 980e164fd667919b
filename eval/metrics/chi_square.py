"""The χ² distribution, to machine precision and without scipy, whose import costs more than a whole evaluation.

Reference: Abramowitz and Stegun, "Handbook of mathematical functions", 1964, 6.5.29 (series), 6.5.31 (continued
fraction), 26.4.17 (Wilson and Hilferty's approximation, from which the search starts).
"""

import math
from statistics import NormalDist

from dronevio.models.errors import ConfigError

_TERMS = 10_000  # far more than ever needed: the series converges within some √(degrees of freedom) terms
_STEPS = 100


def chi_square_below(x: float, degrees: int) -> float:
    """Return the probability that a χ² variable of so many degrees of freedom is below x."""
    return 1.0 - _above(0.5 * degrees, 0.5 * x) if x > degrees else _below(0.5 * degrees, 0.5 * x)


def chi_square_quantile(probability: float, degrees: int) -> float:
    """Return the value below which a χ² variable of so many degrees of freedom stays with a probability.

    Raises:
        ConfigError: The probability is not between 0 and 1, or there are no degrees of freedom.
    """
    if not 0.0 < probability < 1.0 or degrees < 1:
        raise ConfigError(
            f"the {probability:g} quantile of χ² with {degrees} degrees of freedom; expected 0 to 1, of 1"
        )
    a, part = 0.5 * degrees, 2.0 / (9.0 * degrees)
    x = degrees * max(1e-3, 1.0 - part + NormalDist().inv_cdf(probability) * math.sqrt(part)) ** 3
    low, high = 0.0, math.inf
    for _ in range(_STEPS):  # Newton's method, kept between bounds that close in
        excess = chi_square_below(x, degrees) - probability
        low, high = (x, high) if excess < 0.0 else (low, x)
        density = 0.5 * math.exp((a - 1.0) * math.log(0.5 * x) - 0.5 * x - math.lgamma(a))
        step = excess / density if density > 0.0 else math.inf
        better = x - step
        if not low < better < high:
            better = 2.0 * low if math.isinf(high) else 0.5 * (low + high)
        if abs(better - x) <= 1e-15 * x:
            break
        x = better
    return x


def nees_bounds(degrees: int, runs: int = 1, probability: float = 0.95) -> tuple[float, float]:
    """Return between what the mean of NEES values lies with a probability, if the estimator is consistent.

    The values must be independent: those of several runs at one instant, never those along one run.

    Args:
        degrees: Size of the error: 3 for a position or an orientation.
        runs: Over how many runs the mean is taken.
        probability: How sure to be.

    Raises:
        ConfigError: One of them makes no sense.
    """
    if runs < 1 or not 0.0 < probability < 1.0:
        raise ConfigError(f"bounds of the mean NEES of {runs} runs at {probability:g}; expected one at least, 0 to 1")
    tail = 0.5 * (1.0 - probability)
    return tuple(chi_square_quantile(q, degrees * runs) / runs for q in (tail, 1.0 - tail))  # type: ignore[return-value]


def _below(a: float, x: float) -> float:
    """Return the regularized lower incomplete gamma function P(a, x), by its series: for x not above a."""
    if x <= 0.0:
        return 0.0
    term = total = 1.0 / a
    for k in range(1, _TERMS):
        term *= x / (a + k)
        total += term
        if term < 1e-17 * total:
            break
    return total * math.exp(a * math.log(x) - x - math.lgamma(a))


def _above(a: float, x: float) -> float:
    """Return Q(a, x) = 1 − P(a, x), by its continued fraction (Lentz's method): for x above a."""
    b = x + 1.0 - a
    c, d = 1e300, 1.0 / b
    fraction = d
    for k in range(1, _TERMS):
        numerator = -k * (k - a)
        b += 2.0
        d = 1.0 / (numerator * d + b)
        c = b + numerator / c
        fraction *= c * d
        if abs(c * d - 1.0) < 1e-16:
            break
    return fraction * math.exp(a * math.log(x) - x - math.lgamma(a))
