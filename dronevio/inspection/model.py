"""What an inspection finds: rows with a verdict, and the parts of a recording that they are about."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from dronevio.inspection.details import Details


class Verdict(StrEnum):
    """Judgement of one property of a recording."""

    GOOD = "good"
    """As it should be."""
    SUSPECT = "doubtful"
    """The odometry can run, and may be less accurate or pause."""
    WRONG = "wrong"
    """The odometry will fail, or its result will be wrong."""
    UNKNOWN = "not checked"
    """The recording does not determine the property, for example without rotation."""


class Topic(StrEnum):
    """Part of a recording that a finding is about, in the order of the page."""

    CAMERAS = "cameras"
    """The images and their time stamps."""
    IMU = "IMU"
    """The inertial samples and their time stamps."""
    CLOCKS = "clocks"
    """The time stamps of cameras and IMU relative to each other."""
    CALIBRATION = "calibration"
    """Lenses, and poses of the cameras relative to each other and to the IMU."""
    MOTION = "motion"
    """Where the flight rests and moves."""
    TRUTH = "ground truth"
    """The ground truth, if the recording has one."""
    ODOMETRY = "odometry"
    """A run of the odometry, if one was asked for."""


@dataclass(frozen=True)
class Finding:
    """One property of a recording: a row of the page and of the table."""

    topic: Topic
    """Part of the recording."""
    name: str
    """Name of the property, such as ``time offset``."""
    value: float | None
    """The property as a number in SI units, or pixels, or a share; None where it is no single number."""
    verdict: Verdict
    """Judgement of the property."""
    found: str
    """What was found, in words and with units."""
    expected: str
    """What is expected, with the reason of the threshold."""
    advice: str = ""
    """What to do; empty if there is nothing to do."""

    def as_values(self) -> dict[str, object]:
        """Return the finding as a JSON object."""
        value = None if self.value is None or not np.isfinite(self.value) else float(self.value)
        return {
            "topic": str(self.topic),
            "name": self.name,
            "value": value,
            "verdict": str(self.verdict),
            "found": self.found,
            "expected": self.expected,
            "advice": self.advice,
        }


@dataclass(frozen=True, eq=False)
class Inspection:
    """The findings about a recording."""

    name: str
    """Name of the recording."""
    facts: Mapping[str, object]
    """What the recording holds, such as its duration and its numbers of frames and samples; values for JSON."""
    findings: tuple[Finding, ...]
    """All rows, in the order of the topics."""
    details: "Details" = field(repr=False)
    """The measurements behind them, for the plots of the page."""

    @cached_property
    def page(self) -> str:
        """The page as HTML."""
        from dronevio.inspection.page import inspection_page  # Matplotlib takes half a second

        return inspection_page(self.name, self.findings, self.facts, self.details)

    @property
    def verdict(self) -> Verdict:
        """The worst verdict of all rows."""
        return worst(self.findings)

    @property
    def summary(self) -> str:
        """Whether the odometry will work on the recording, and why not, on one line."""
        return summary_of(self.findings)

    def as_values(self) -> dict[str, object]:
        """Return the inspection as a JSON object, without the page."""
        return {
            "recording": self.name,
            "verdict": str(self.verdict),
            "summary": self.summary,
            **self.facts,
            "findings": [finding.as_values() for finding in self.findings],
        }


def graded(value: float, suspect: float, wrong: float) -> Verdict:
    """Return the verdict on a value that should be small: good up to a limit, wrong beyond another one."""
    if not value > suspect:
        return Verdict.GOOD
    return Verdict.WRONG if value > wrong else Verdict.SUSPECT


def more_severe(*verdicts: Verdict) -> Verdict:
    """Return the most severe of some verdicts."""
    return max(verdicts, key=[Verdict.GOOD, Verdict.UNKNOWN, Verdict.SUSPECT, Verdict.WRONG].index)


def worst(findings: Sequence[Finding]) -> Verdict:
    """Return the worst verdict of some rows; good without any."""
    verdicts = {finding.verdict for finding in findings}
    return next((each for each in (Verdict.WRONG, Verdict.SUSPECT) if each in verdicts), Verdict.GOOD)


def summary_of(findings: Sequence[Finding]) -> str:
    """Return whether the odometry will work, with the rows that speak against it, on one line."""
    verdict = worst(findings)
    reasons = [finding for finding in findings if finding.verdict is verdict]
    because = "; ".join(f"{each.topic}, {each.name}: {each.found}" for each in reasons)
    if verdict is Verdict.WRONG:
        return f"will not work as it is: {because}"
    if verdict is Verdict.SUSPECT:
        return f"doubtful: {because}"
    return "will work: nothing speaks against it"
