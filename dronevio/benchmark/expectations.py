"""Expected outcomes of the scenarios of the suite ``stress``, stated before its runs.

The error is within 2, 4 and 8 times that of the flight without the fault, by strength. Instead, an estimator may lose
track for a while and report it: during a fault of limited duration and for two seconds after it, which is the time
within which an initialization in motion is expected, and for three seconds with a fault of the highest strength that
lasts. After a loss, the position is that of the inertial navigation, whose error has no such bound.
"""

from dronevio.eval.benchmark.outcomes import Expectation

CLEAN = "room-v0"
"""Name of the scenario without a fault."""
_RATIOS = (2.0, 4.0, 8.0)  # by strength
_LASTING_LOSS_S = (0.0, 0.0, 3.0)
_RECOVERY_S = 2.0
_LASTING = (
    ("drops-25", "drops", "drops-75"),
    ("jitter-1ms", "jitter-3ms", "jitter-10ms"),
    ("offset-2ms", "offset", "offset-15ms"),
    ("tilt-20min", "tilt", "tilt-3deg"),
    ("noise", "noise-4x", "noise-8x"),
    ("saturated-86dps", "saturated", "saturated-40dps"),
)
"""Faults that last for the whole flight, by strength."""
_PASSING = (
    (("dark-1s", 1.0), ("dark-2s", 2.0), ("dark-5s", 5.0)),
    (("rotor-landing", 0.0), ("rotor-low", 0.4), ("rotor-flight", 0.9)),
)
"""Faults of limited duration [s], by strength. A flight whose rotor fails ends when the vehicle falls on the ground."""


def _stress() -> dict[str, Expectation]:
    """Return the expected outcomes by name of the scenario."""
    expected = {CLEAN: Expectation(CLEAN, 1.0)}
    for names in _LASTING:
        for name, ratio, loss_s in zip(names, _RATIOS, _LASTING_LOSS_S, strict=True):
            expected[f"room-{name}-v0"] = Expectation(CLEAN, ratio, loss_s)
    for faults in _PASSING:
        for (name, duration_s), ratio in zip(faults, _RATIOS, strict=True):
            loss_s = duration_s + _RECOVERY_S if duration_s else 0.0
            expected[f"room-{name}-v0"] = Expectation(CLEAN, ratio, loss_s)
    expected["room-motion-v0"] = Expectation(CLEAN, _RATIOS[1])
    return expected


EXPECTATIONS: dict[str, Expectation] = _stress()
"""Expected outcomes by name of the scenario, for all scenarios of the suite ``stress``."""
