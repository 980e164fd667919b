"""The jobs of a benchmark: flights to estimate, how their recordings are made, and how estimators are run."""

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import dronevio
from dronevio.benchmark.measured_flights import MeasuredFlight
from dronevio.benchmark.variants import AS_IS, RIG, variant_of
from dronevio.estimators.registry import NamedEstimator
from dronevio.eval.benchmark.cache import code_hash, content_hash, recording_hash
from dronevio.eval.benchmark.jobs import RecordingSpec
from dronevio.eval.benchmark.metrics import OwnMetric
from dronevio.eval.benchmark.rows import VARIANT_SIGN
from dronevio.eval.provenance import versions_here
from dronevio.models.defects import defects_text
from dronevio.models.errors import ConfigError, EvaluationError, InputError
from dronevio.models.imu import Times
from dronevio.models.rig import euroc_rig
from dronevio.models.serialization import to_jsonable

if TYPE_CHECKING:
    from dronevio.eval.metrics.loops import FlightRevisits
    from dronevio.models.slam_map import SlamMap
    from dronevio.sim.scenario import Scenario

_ROOT = Path(dronevio.__file__).parent
_RENDERING_CODE = tuple(
    _ROOT / name for name in ("sim", "models", "recording/recorder.py", "benchmark/measured_flights.py")
)
_ESTIMATION_CODE = tuple(
    _ROOT / name
    for name in (
        "estimator",
        "eval/metrics",
        "eval/run.py",
        "eval/tracking.py",
        "eval/benchmark/metrics.py",
        "estimators",
        "recording/excerpts.py",
        "benchmark/true_views.py",
    )
)
_RENDERING_PACKAGES = ("dronevio", "mujoco", "opencv-python-headless", "numpy")
_PACKAGES = (*_RENDERING_PACKAGES, "python", "gtsam")
"""The packages on which a row depends."""


def versions() -> str:
    """Return the versions of the packages and the hash of our code, on which rows depend besides settings."""
    installed = versions_here()
    packages = [f"{name} {installed[name]}" for name in _PACKAGES if name in installed]
    return ", ".join([*packages, f"code {code_hash(*_RENDERING_CODE, *_ESTIMATION_CODE)}"])


@dataclass(frozen=True)
class Workbench:
    """Makes recordings and runs estimators on them; implements `BenchmarkPipeline`."""

    estimators: tuple[NamedEstimator, ...]
    """The estimators of the benchmark."""
    versions: str
    """Versions of the machine that planned the benchmark; all machines must have the same."""
    strict: bool = False
    """Whether recordings with defects are refused."""
    own_metrics: tuple[OwnMetric, ...] = ()
    """Metrics of the user that are computed as well."""

    def config_hash(self, estimator: str) -> str:
        """Return a hash of an estimator's settings."""
        return content_hash(self._named(estimator).settings())

    def record(self, spec: RecordingSpec, folder: Path, images: Path | None = None) -> None:
        """Write the recording of a flight, with the images of another recording if there is one."""
        from dronevio.recording.recorder import record_flight
        from dronevio.sim.scenario import Scenario

        self._check_here()
        if isinstance(spec.source, MeasuredFlight):
            spec.source.record(folder)
            return
        assert isinstance(spec.source, Scenario)
        record_flight(spec.source, folder, workers=1, images_of=images)

    def estimate(self, spec: RecordingSpec, recording: Path, estimator: str) -> dict[str, Any]:
        """Run an estimator on a recording and score its estimate."""
        from dronevio.benchmark.own_metrics import PythonMetric
        from dronevio.eval.benchmark.isolation import peak_memory_mb
        from dronevio.eval.benchmark.metrics import EvaluatedRun, RunCost, run_columns
        from dronevio.eval.metrics.scores import score_trajectory
        from dronevio.models.recordings.open import open_recording
        from dronevio.recording.excerpts import excerpt_of

        self._check_here()
        opened = excerpt_of(open_recording(recording, 1, repair=True), spec.start_s, spec.laps)
        truth, frames = opened.ground_truth, opened.frame_times_ns
        if truth is None:
            raise InputError(recording, "no ground truth", "a recording with the true motion")
        estimated = self._named(estimator).run(recording, self.strict, spec.start_s, spec.laps)
        run, map_cost = estimated.run, estimated.map_cost
        scored = score_trajectory(truth, estimated.trajectory, frames)
        cost = RunCost(
            estimated.cpu_ms_mean,
            estimated.cpu_ms_p99,
            estimated.real_time_factor,
            peak_memory_mb(),  # before the revisits are found, which is not the work of the estimator
            None if map_cost is None else map_cost.worker_cpu_ms_per_frame,
            None if map_cost is None else map_cost.results,
            None if map_cost is None else map_cost.waits,
        )
        is_whole = not spec.start_s and spec.laps == 1
        revisits = _revisits(recording, None if run is None else run.map) if is_whole else None
        evaluated = EvaluatedRun(scored, cost, opened.rig.cameras[0], run, revisits)
        own = {metric.name: PythonMetric.parse(metric.name).value(scored) for metric in self.own_metrics}
        return {**run_columns(evaluated), **own, "defects": defects_text(estimated.defects)}

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


def scenario_flights(
    names: Iterable[str],
    seeds: Sequence[int],
    rig: str | None = None,
    variants: Sequence[str] = (),
    image_sensor: str | None = None,
) -> tuple[RecordingSpec, ...]:
    """Return the flights of scenarios, every seed of each; the name of a suite stands for its scenarios.

    The first seed of all scenarios comes first, then the second, so that early results cover all scenarios.
    Flights that differ in their IMU only share the images of the first of them.

    Args:
        names: Names of scenarios and suites.
        seeds: Seeds of the flights.
        rig: Sensors that replace those of the scenarios: a name or a file, see `recorder.rig_of`.
        variants: Variants of each scenario, see `benchmark_variants.variant_of`; none for the scenarios themselves.
        image_sensor: Name of the image sensor that replaces those of the scenarios.

    Raises:
        ConfigError: There is no such scenario, suite, rig, variant or image sensor, or a variant is given twice.
        InputError: The rig's file cannot be read.
    """
    from dronevio.sim.scenarios import SUITES, scenario_named

    scenarios = {name: scenario_named(name) for given in names for name in SUITES.get(given, (given,))}
    unique = {flown.name: flown for flown in scenarios.values()}
    if rig is not None:
        from dronevio.recording.recorder import rig_of

        chosen = rig_of(rig)
        unique = {name: replace(flown, rig=chosen) for name, flown in unique.items()}
        if replaced := next((name for name in variants if RIG in name), None):
            raise ConfigError(f"--rig {rig} with the variant {replaced}, which replaces it; expected one of them")
    if image_sensor is not None:
        from dronevio.sim.cameras.imaging import image_sensor_named

        imaging = image_sensor_named(image_sensor)
        unique = {name: replace(flown, imaging=imaging) for name, flown in unique.items()}
    flights = [variant_of(flown, variant) for flown in unique.values() for variant in variants or (AS_IS,)]
    if repeated := next((name for name, count in Counter(each.name for each in flights).items() if count > 1), None):
        raise ConfigError(f"variant {repeated.partition(VARIANT_SIGN)[2] or AS_IS} twice; expected each once")
    rendered: dict[str, RecordingSpec] = {}
    specs = []
    for seeded in (replace(flown, seed=seed) for seed in seeds for flown in flights):
        spec = _flight(seeded)
        first = rendered.setdefault(_images_hash(seeded), spec)
        specs.append(spec if first is spec else replace(spec, images_of=first))
    return tuple(specs)


def measured_recordings(
    flights: Iterable[MeasuredFlight], seeds: Sequence[int], image_sensor: str | None = None
) -> tuple[RecordingSpec, ...]:
    """Return the recordings of measured flights, every seed of each, in the order of `scenario_flights`.

    Args:
        flights: The flights.
        seeds: Seeds of their worlds and of the image noise.
        image_sensor: Name of the image sensor that replaces the standard one.

    Raises:
        ConfigError: There is no such image sensor.
        InputError: The data of a flight is missing.
    """
    from dronevio.sim.cameras.imaging import image_sensor_named

    imaging, flights, specs = image_sensor_named(image_sensor or "standard"), tuple(flights), []
    for flown in (replace(flight, seed=seed, imaging=imaging) for seed in seeds for flight in flights):
        settings = to_jsonable(replace(flown, name="", folder=Path()))
        files = [recording_hash(file) for file in flown.files]
        digest = _rendering_hash({"measured": settings, "files": files})
        specs.append(RecordingSpec(flown.name, flown.world, flown.seed, digest, flown))
    return tuple(specs)


def recorded_flights(paths: Iterable[Path]) -> tuple[RecordingSpec, ...]:
    """Return the flights of existing recordings, with the names of their files or folders.

    Raises:
        InputError: A recording is missing or has no ground truth.
        ConfigError: Two recordings have the same name.
    """
    from dronevio.models.recordings.open import read_trajectory

    flights: dict[str, RecordingSpec] = {}
    for path in paths:
        is_inner = path.resolve().name == "mav0"
        given = (path.parent if path.name == "mav0" else path / "..") if is_inner else path  # for messages
        whole = path.resolve().parent if is_inner else path.resolve()
        digest = recording_hash(given)
        read_trajectory(given)  # raises an error without ground truth before the first run
        name = whole.stem if whole.is_file() else whole.name
        if name in flights:
            raise ConfigError(f"{path} and {flights[name].path}, both named {name}; expected different names")
        flights[name] = RecordingSpec(name, "", None, digest, None, whole)
    return tuple(flights.values())


def excerpts(
    flights: Sequence[RecordingSpec], starts_s: Sequence[float] = (), laps: int = 1
) -> tuple[RecordingSpec, ...]:
    """Return flights that are estimated from several times on, and that are repeated; their names state both.

    All flights come with the first start, then all with the second, so that a recording is made once.

    Args:
        flights: The flights.
        starts_s: Times after the first frame at which estimators start [s]; none for the beginning.
        laps: Number of times that each flight is repeated without a break.

    Raises:
        ConfigError: A start is negative or occurs twice, or starts and laps are given together.
    """
    if starts_s and laps > 1:
        raise ConfigError(f"--starts-s with --laps {laps}; expected one of them")
    if any(start_s < 0.0 for start_s in starts_s) or len(set(starts_s)) < len(starts_s):
        raise ConfigError(
            f"--starts-s {' '.join(f'{each:g}' for each in starts_s)}; expected different times from 0 s on"
        )
    if laps > 1:
        return tuple(replace(flight, scenario=f"{flight.scenario}×{laps}", laps=laps) for flight in flights)
    begun = (
        replace(flight, scenario=f"{flight.scenario}@{start_s:g}s", start_s=start_s)
        for start_s in starts_s
        for flight in flights
    )
    return tuple(begun) or tuple(flights)


def _revisits(recording: Path, slam_map: "SlamMap | None") -> "FlightRevisits | None":
    """Return the revisits of a recording by the truth of the simulator; None if it is no flight of the simulator.

    They are computed in a process of their own, in about four seconds: it imports the simulator.

    Raises:
        EvaluationError: The world is unknown, or the process failed.
    """
    from dronevio.eval.benchmark.isolation import call_in_process
    from dronevio.models.recordings.scenario_file import has_world

    if not has_world(recording):
        return None
    outcome = call_in_process(_find_revisits, recording, np.zeros(0, np.int64) if slam_map is None else slam_map.t_ns)
    if outcome.status != "ok":
        raise EvaluationError(f"{recording}: revisits cannot be found: {outcome.reason}")
    revisits: FlightRevisits = outcome.value
    return revisits


def _find_revisits(recording: Path, keyframe_times_ns: Times) -> "FlightRevisits":
    from dronevio.benchmark.true_views import recording_revisits  # imports the simulator

    return recording_revisits(recording, keyframe_times_ns)


def _flight(flown: "Scenario") -> RecordingSpec:
    """Return the flight of a scenario, with the hash of everything that determines its recording."""
    return RecordingSpec(flown.name, flown.recorded.world, flown.seed, _recording_hash(flown), flown)


def _recording_hash(flown: "Scenario") -> str:
    """Return the hash of everything that determines the recording of a scenario; its name does not."""
    return _rendering_hash({"scenario": to_jsonable(replace(flown, name="", description=""))})


def _rendering_hash(settings: dict[str, object]) -> str:
    """Return the hash of the settings of a recording, and of the code and packages that make it."""
    return content_hash({**settings, **_renderer()})


@cache
def _renderer() -> dict[str, object]:
    """Return the packages and the hash of the code that make recordings; read once for all flights of a benchmark."""
    installed = versions_here()
    packages = {name: installed.get(name) for name in _RENDERING_PACKAGES}
    return {"packages": packages, "code": code_hash(*_RENDERING_CODE)}


def _images_hash(flown: "Scenario") -> str:
    """Return the hash of everything that determines the images of a scenario: all but the IMU."""
    control_rate_hz = flown.control_rate_hz or flown.rig.imu.rate_hz
    imu = replace(euroc_rig().imu, rate_hz=control_rate_hz)
    return _recording_hash(
        replace(
            flown,
            rig=replace(flown.rig, imu=imu),
            faults=replace(flown.faults, imu_noise_factor=1.0),
            control_rate_hz=None,
        )
    )
