"""The jobs of a benchmark: flights to estimate, how their recordings are made, and how estimators are run."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import dronevio
from dronevio.eval.benchmark.cache import code_hash, content_hash, recording_hash
from dronevio.eval.benchmark.jobs import RecordingSpec
from dronevio.eval.benchmark.rows import score_columns
from dronevio.eval.provenance import versions_here
from dronevio.models.defects import defects_text
from dronevio.models.errors import ConfigError, InputError
from dronevio.models.serialization import to_jsonable
from dronevio.registry import NamedEstimator

if TYPE_CHECKING:
    from dronevio.sim.scenario import Scenario

_ROOT = Path(dronevio.__file__).parent
_RENDERING_CODE = tuple(_ROOT / name for name in ("sim", "models", "recorder.py"))
_ESTIMATION_CODE = tuple(
    _ROOT / name
    for name in (
        "estimator",
        "eval/metrics",
        "eval/tracking.py",
        "driver.py",
        "external_program.py",
        "python_estimator.py",
        "registry.py",
    )
)
_RENDERING_PACKAGES = ("dronevio", "mujoco", "opencv-python-headless", "numpy")
_PACKAGES = (*_RENDERING_PACKAGES, "python", "gtsam")
"""The packages on which a row depends."""


def versions() -> str:
    """Return the versions of the packages and the hash of our code, on which rows depend besides settings."""
    found = versions_here()
    packages = [f"{name} {found[name]}" for name in _PACKAGES if name in found]
    return ", ".join([*packages, f"code {code_hash(*_RENDERING_CODE, *_ESTIMATION_CODE)}"])


@dataclass(frozen=True)
class Workbench:
    """Simulates flights and runs estimators on them; implements `BenchmarkPipeline`."""

    estimators: tuple[NamedEstimator, ...]
    """The estimators of the benchmark."""
    versions: str
    """Versions of the machine that planned the benchmark; all machines must have the same."""
    strict: bool = False
    """Whether recordings with defects are refused."""

    def config_hash(self, estimator: str) -> str:
        """Return a hash of an estimator's settings."""
        return content_hash(self._named(estimator).settings())

    def record(self, spec: RecordingSpec, folder: Path) -> None:
        """Simulate a scenario and write its recording."""
        from dronevio.recorder import record_flight
        from dronevio.sim.scenario import Scenario

        self._check_here()
        assert isinstance(spec.source, Scenario)
        record_flight(spec.source, folder, workers=1)

    def estimate(self, spec: RecordingSpec, recording: Path, estimator: str) -> dict[str, Any]:
        """Run an estimator on a recording and score its estimate."""
        from dronevio.eval.metrics.scores import score
        from dronevio.eval.tracking import longest_loss_s, tracking_sigmas
        from dronevio.models.recordings.open import open_recording

        self._check_here()
        opened = open_recording(recording, 1, repair=True)
        if opened.ground_truth is None:
            raise InputError(recording, "no ground truth", "a recording with the true motion")
        estimated = self._named(estimator).run(recording, self.strict)
        frames = opened.frame_times_ns
        return {
            **score_columns(score(opened.ground_truth, estimated.trajectory, frames)),
            "duration_s": float(np.ptp(frames)) * 1e-9,
            "cpu_ms_mean": estimated.cpu_ms_mean,
            "cpu_ms_p99": estimated.cpu_ms_p99,
            "real_time_factor": estimated.real_time_factor,
            "defects": defects_text(estimated.defects),
            "longest_loss_s": None if estimated.run is None else longest_loss_s(estimated.run),
            "tracking_sigmas": None if estimated.run is None else tracking_sigmas(estimated.run, opened.ground_truth),
        }

    def _named(self, label: str) -> NamedEstimator:
        return next(estimator for estimator in self.estimators if estimator.label == label)

    def _check_here(self) -> None:
        """Check that code and packages are those of the machine that planned the benchmark.

        Raises:
            ConfigError: They differ.
        """
        here, there = versions().split(", "), self.versions.split(", ")
        if here != there:
            differing = "; expected ".join(
                ", ".join(p for p in a if p not in b) for a, b in ((here, there), (there, here))
            )
            raise ConfigError(f"code or packages differ: {differing}, as on the machine that started the benchmark")


def scenario_flights(names: Iterable[str], seeds: Sequence[int], rig: str | None = None) -> tuple[RecordingSpec, ...]:
    """Return the flights of scenarios, every seed of each; the name of a suite stands for its scenarios.

    The first seed of all scenarios comes first, then the second, so that early results cover all scenarios.

    Args:
        names: Names of scenarios and suites.
        seeds: Seeds of the flights.
        rig: Sensors that replace those of the scenarios: a name or a file, see `recorder.rig_of`.

    Raises:
        ConfigError: There is no such scenario, suite or rig.
        InputError: The rig's file cannot be read.
    """
    from dronevio.sim.scenarios import SUITES, scenario_named

    found = {name: scenario_named(name) for given in names for name in SUITES.get(given, (given,))}
    unique = {flown.name: flown for flown in found.values()}
    if rig is not None:
        from dronevio.recorder import rig_of

        chosen = rig_of(rig)
        unique = {name: replace(flown, rig=chosen) for name, flown in unique.items()}
    return tuple(_flight(replace(flown, seed=seed)) for seed in seeds for flown in unique.values())


def recorded_flights(paths: Iterable[Path]) -> tuple[RecordingSpec, ...]:
    """Return the flights of existing recordings, with the names of their files or folders.

    Raises:
        InputError: A recording is missing or has no ground truth.
        ConfigError: Two recordings have the same name.
    """
    from dronevio.models.recordings.open import read_trajectory

    flights: dict[str, RecordingSpec] = {}
    for path in paths:
        whole = path.resolve().parent if path.resolve().name == "mav0" else path.resolve()
        digest = recording_hash(whole)
        read_trajectory(whole)  # raises an error without ground truth before the first run
        name = whole.stem if whole.is_file() else whole.name
        if name in flights:
            raise ConfigError(f"{path} and {flights[name].path}, both named {name}; expected different names")
        flights[name] = RecordingSpec(name, "", None, digest, None, whole)
    return tuple(flights.values())


def _flight(flown: "Scenario") -> RecordingSpec:
    """Return the flight of a scenario, with the hash of everything that determines its recording; the name does not."""
    installed = versions_here()
    settings = to_jsonable(replace(flown, name="", description=""))
    packages = {name: installed.get(name) for name in _RENDERING_PACKAGES}
    digest = content_hash({"scenario": settings, "packages": packages, "code": code_hash(*_RENDERING_CODE)})
    return RecordingSpec(flown.name, flown.world, flown.seed, digest, flown)
