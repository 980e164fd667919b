"""What one revision computes, as arrays: the part of `compare_revisions.py` that runs inside that revision.

The process has the revision's own code on its ``PYTHONPATH``. This module names as little of that code as possible,
and `NAMES` and `RENAMED` have all of it: where a name has moved, add its new place there. Files of the EuRoC layout are
read by NumPy and OpenCV alone, so that a change of the package's own readers cannot hide a change of what was written::

    python tools/revision_probe.py estimate FOLDER --code EXPORT --out estimate.npz
    python tools/revision_probe.py vector-environments --code EXPORT --out environments.npz
    python tools/revision_probe.py ate FOLDER FOLDER ... --code EXPORT --out ate.npz
"""

import argparse
import hashlib
import importlib
import re
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Arrays = dict[str, npt.NDArray[Any]]
"""Arrays by the name of a quantity, with its unit in brackets."""

_PUBLIC = (
    "SlamConfig",
    "Trajectory",
    "ImuRatePropagator",
    "VisualInertialOdometry",
    "VisualSlam",
    "ate",
    "dense",
    "estimate",
    "evaluate",
    "evaluate_policy",
    "fly_on_estimate",
    "inspect",
    "load_policy",
    "measurements",
    "open_recording",
    "scenario_named",
    "sfm",
)
NAMES: dict[str, tuple[str, ...]] = {
    **{name: (f"dronevio:{name}",) for name in _PUBLIC},
    "read_flight": (
        "dronevio.estimator.book.eqvio:read_feature_recording",
        "dronevio.estimator.book.eqvio:read_flight",
    ),
    "ReplayedFeatures": (
        "dronevio.estimator.book.eqvio:ReplayFrontEnd",
        "dronevio.estimator.book.eqvio:ReplayedFeatures",
    ),
    "run_eqvio": ("dronevio.estimator.book.eqvio:run_eqvio",),
    "DenseConfig": ("dronevio.estimator.dense:DenseConfig",),
    "vio_rig": ("dronevio.envs:vio_rig",),
    "MODERATE": ("dronevio.sim.envs:MODERATE", "dronevio.sim.envs.randomization:MODERATE"),
}
"""Every name of the package that is used here, and where revisions have it, the newest place first."""

RENAMED = {"landmarks_odom": "landmarks_world", "T_odom_imu": "T_world_imu"}
"""Attributes of results that are or will be renamed: their new names, and those that stand in the names of arrays."""
TIMES = frozenset({"times_s", "cpu_ms", "wall_ms"})
"""Attributes of results that differ from run to run."""

HEALTH_STATES = {"initialising": "initializing"}
"""Health states that were renamed, and their present names."""

_REPORTED = (
    "tracks",
    "landmarks",
    "median_parallax_rad",
    "innovation_px",
    "innovation_nis",
    "bias_sigmas",
    "position_sigma_m",
    "velocity_sigma_m_s",
    "inertial_only_s",
)
_TRUTH_COLUMNS = {
    "truth position [m]": slice(1, 4),
    "truth quaternion": slice(4, 8),
    "truth velocity [m/s]": slice(8, 11),
    "truth gyro bias [rad/s]": slice(11, 14),
    "truth accel bias [m/s²]": slice(14, 17),
}
_NUMBER = re.compile(r"(?<![\w.])[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?(?![\w.])")


def found(name: str) -> Any:
    """Return what the revision has under one of the places of `NAMES`.

    Raises:
        ImportError: None of the places exists.
    """
    for place in NAMES[name]:
        module, _, attribute = place.partition(":")
        try:
            return getattr(importlib.import_module(module), attribute)
        except AttributeError:
            continue
        except ModuleNotFoundError as error:
            if not (error.name or "").startswith("dronevio"):
                raise
    raise ImportError(f"no {name} at {', '.join(NAMES[name])}; add its new place to NAMES in {__file__}")


def check_code(folder: Path) -> None:
    """Check that the package is imported from a folder.

    Raises:
        ImportError: It comes from elsewhere, such as from the environment's own editable installation.
    """
    import dronevio

    file = Path(str(dronevio.__file__)).resolve()
    if not file.is_relative_to(folder.resolve()):
        raise ImportError(f"dronevio is imported from {file}; expected it below {folder.resolve()}")


def attribute(value: Any, name: str) -> Any:
    """Return an attribute under its new name of `RENAMED`, or the given one."""
    names = [new for new, old in RENAMED.items() if old == name and hasattr(value, new)]
    return getattr(value, names[0] if names else name)


def flattened(name: str, value: Any) -> Arrays:
    """Return all numbers and words in nested dataclasses, mappings and sequences, by the names of their places."""
    if is_dataclass(value) and not isinstance(value, type):
        value = {RENAMED.get(f.name, f.name): getattr(value, f.name) for f in fields(value) if f.name not in TIMES}
    if isinstance(value, Mapping):
        items: Iterable[tuple[Any, Any]] = value.items()
    elif isinstance(value, (tuple, list)) and not all(isinstance(one, (int, float, str)) for one in value):
        items = enumerate(value)
    else:
        array = np.asarray(value)
        return {name: array if array.dtype.kind in "biufUS" else np.array(list(map(str, array.ravel())), dtype="U")}
    return {key: array for place, part in items for key, array in flattened(f"{name} {place}", part).items()}


def estimate(folder: Path) -> Arrays:
    """Return what the odometry estimates on a recording, frame by frame, and in between at the rate of the IMU."""
    recording = found("open_recording")(folder)
    return estimates_of(recording, found("VisualInertialOdometry")(recording.rig))


def eqvio() -> Arrays:
    """Return what the odometry, and GTSAM's equivariant filter, estimate on the features of a real flight."""
    flight = found("read_flight")()
    arrays = estimates_of(flight, found("VisualInertialOdometry")(flight.rig, None, found("ReplayedFeatures")(flight)))
    filtered = found("run_eqvio")(flight)
    return {**arrays, "EqVIO position [m]": np.asarray(filtered.p_world_imu)}


def slam(folder: Path) -> Arrays:
    """Return what visual SLAM estimates on a recording, its final map, and what it estimates with that map loaded."""
    recording, config = found("open_recording")(folder), found("SlamConfig")(worker=False)
    estimator = found("VisualSlam")(recording.rig, None, config)
    arrays = estimates_of(recording, estimator)
    arrays |= flattened("final map", estimator.final_map())
    arrays |= flattened("map landmarks", estimator.reconstruction())
    with tempfile.TemporaryDirectory() as scratch:
        estimator.save_map(Path(scratch) / "map.npz")
        estimator.save_graph(Path(scratch) / "graph.g2o")
        arrays["graph"] = np.array((Path(scratch) / "graph.g2o").read_text().splitlines(), dtype="U")
        localized = found("VisualSlam")(recording.rig, None, config, map=Path(scratch) / "map.npz", localize_only=True)
        again = estimates_of(recording, localized, frames=100)
    return arrays | {f"localized {name}": values for name, values in again.items()}


def sfm(folder: Path) -> Arrays:
    """Return cameras and points from the images of a recording alone, and their surfaces."""
    result, config = found("sfm")(folder), found("DenseConfig")()
    small = replace(config, views=replace(config.views, max_side_px=160))
    return flattened("sfm", result) | flattened("dense", found("dense")(folder, result, small))


def scores(folder: Path) -> Arrays:
    """Return how a disturbed copy of the truth is evaluated, and what the inspection of a recording finds."""
    recording = found("open_recording")(folder)
    truth = recording.ground_truth[:: max(1, len(recording.ground_truth) // 200)]
    noise = np.random.default_rng(0).normal(0.0, 0.01, truth.p_world_imu.shape).cumsum(axis=0)
    disturbed = replace(truth, p_world_imu=truth.p_world_imu + noise)
    inspection = found("inspect")(folder)
    return {
        **flattened("evaluation", found("evaluate")(recording, disturbed)),
        **flattened("inspection", {"facts": inspection.facts, "findings": inspection.findings}),
    }


def on_estimate() -> Arrays:
    """Return what is recorded and estimated on a flight whose controller receives the estimate."""
    scenario = replace(found("scenario_named")("short", 4), rig=found("vio_rig")())
    with tempfile.TemporaryDirectory() as scratch:
        _, run = found("fly_on_estimate")(scenario, Path(scratch) / "flight")
        return flight(Path(scratch) / "flight") | estimate_arrays(run.estimates)


def environments(*, vector: bool = False, on_estimate: bool = False, steps: int = 200) -> Arrays:
    """Return rollouts of random actions in all registered environments.

    Args:
        vector: Whether three of each are stepped together, with randomized vehicles and sensors.
        on_estimate: Whether to use the environments that are flown on an estimate, and only these.
        steps: Number of steps.
    """
    import gymnasium

    importlib.import_module("dronevio.envs")
    arrays: Arrays = {}
    for name, spec in sorted(gymnasium.registry.items()):
        if not name.startswith("dronevio/") or on_estimate != (spec.vector_entry_point is None):
            continue
        if vector:
            env: Any = gymnasium.make_vec(name, num_envs=3, randomization=found("MODERATE"), max_episode_steps=40)
        else:
            env = gymnasium.make(name)
        try:
            values = stacked(rollout(env, steps, vector=vector))
        finally:
            env.close()
        arrays |= {f"{name.partition('/')[2]} {key}": array for key, array in values.items()}
    return arrays


def rollout(env: Any, steps: int, *, vector: bool) -> Iterator[Arrays]:
    """Yield all values of each step of random actions, of which every second one repeats the last."""
    env.action_space.seed(0)
    observation, info = env.reset(seed=0)
    yield flattened("start", {"observation": observation, "info": info})
    for step in range(steps):
        if step % 2 == 0:
            action = env.action_space.sample()
        observation, reward, terminated, truncated, info = env.step(action)
        values = {"observation": observation, "reward": reward, "terminated": terminated, "truncated": truncated}
        yield flattened("step", {**values, "info": info})
        if not vector and (terminated or truncated):
            observation, info = env.reset()
            yield flattened("start", {"observation": observation, "info": info})


def stacked(steps: Iterable[Arrays]) -> Arrays:
    """Return the values of all steps that have them, by name, as one array; with the numbers of those steps."""
    values: dict[str, list[npt.NDArray[Any]]] = {}
    places: dict[str, list[int]] = {}
    for number, arrays in enumerate(steps):
        for name, array in arrays.items():
            values.setdefault(name, []).append(array)
            places.setdefault(name, []).append(number)
    same = {name: np.stack(arrays) for name, arrays in values.items() if len({a.shape for a in arrays}) == 1}
    uneven = {name: np.concatenate([a.ravel() for a in arrays]) for name, arrays in values.items() if name not in same}
    return {**same, **uneven, "steps": np.array([f"{name} {at}" for name, at in places.items()], dtype="U")}


def policies(code: Path) -> Arrays:
    """Return the results of the policies in the repository."""
    arrays: Arrays = {}
    for file in sorted(code.glob("examples/rl/policies/*.safetensors")):
        arrays |= flattened(
            file.stem, found("evaluate_policy")(found("load_policy")(file), 3, 1, max_episode_steps=500)
        )
    return arrays


def ates(folders: Sequence[Path]) -> Arrays:
    """Return the absolute trajectory error [m] and the number of poses of the odometry on each recording.

    The error is not a number where the odometry fails, which includes any exception.
    """
    table = np.full((len(folders), 2), np.nan)
    for row, folder in zip(table, folders, strict=True):
        try:
            run = found("estimate")(folder)
            row[:] = found("ate")(folder, run).rmse, len(run.trajectory.t_ns)
        except Exception as error:  # a flight that fails counts, whatever the reason
            print(f"{folder.name}: {type(error).__name__}: {error}")
    return {"ATE [m]": table[:, 0], "poses": table[:, 1]}


def estimates_of(recording: Any, estimator: Any, frames: int | None = None) -> Arrays:
    """Push a recording through an estimator on one thread, and return what it estimates, frame by frame."""
    cv2.setNumThreads(1)
    estimates: list[Any] = []
    propagator, states = found("ImuRatePropagator")(recording.rig.imu), []
    for measurement in found("measurements")(recording):
        if hasattr(measurement, "gyro_rad_s"):
            estimator.add_imu(measurement)
            states += propagator.add_imu(measurement)
        else:
            estimates.append(estimator.add_frame(measurement))
            propagator.correct(estimates[-1])
        if len(estimates) == frames:
            break
    path = found("Trajectory").from_states(states)
    return {
        **estimate_arrays(estimates),
        "IMU-rate time [ns]": path.t_ns,
        "IMU-rate position [m]": path.p_world_imu,
        "IMU-rate quaternion": path.quat_wxyz,
    }


def estimate_arrays(estimates: Sequence[Any]) -> Arrays:
    """Return what is estimated frame by frame."""
    states = [e.state for e in estimates]
    T = rows((attribute(s, "T_world_imu") for s in states if s is not None), states, (4, 4))
    tracks = [e.tracks for e in estimates if e.tracks is not None]
    landmarks = [attribute(e, "landmarks_world") for e in estimates]
    reports = [getattr(e, "health_report", None) for e in estimates]
    numbers = [[getattr(report, name, None) for name in _REPORTED] for report in reports]
    T_map_odom = rows((e.T_map_odom for e in estimates), estimates, (4, 4))
    return {
        "time [ns]": np.array([e.t_ns for e in estimates], dtype=np.int64),
        "has state": np.array([s is not None for s in states], dtype=np.bool_),
        "health": np.array([HEALTH_STATES.get(str(e.health), str(e.health)) for e in estimates], dtype="U24"),
        "health report": np.array(numbers, dtype=np.float64),
        "position [m]": T[:, :3, 3],
        "rotation [rad]": T[:, :3, :3],
        "velocity [m/s]": rows((s.velocity_m_s for s in states if s is not None), states, (3,)),
        "gyro bias [rad/s]": rows((s.gyro_bias_rad_s for s in states if s is not None), states, (3,)),
        "accel bias [m/s²]": rows((s.accel_bias_m_s2 for s in states if s is not None), states, (3,)),
        "covariance [relative]": rows((s.covariance for s in states if s is not None), states, (15, 15)),
        "track ids": np.concatenate([np.zeros(0, np.int64), *(t.ids for t in tracks)]),
        "track pixels [px]": np.concatenate([np.zeros((0, 2)), *(t.pixels for t in tracks)]),
        "landmarks [m]": np.concatenate([np.zeros((0, 3)), *(p for p in landmarks if p is not None)]),
        "map position [m]": T_map_odom[:, :3, 3],
        "rotation of map [rad]": T_map_odom[:, :3, :3],
        "covariance in map [relative]": rows((e.map_covariance for e in estimates), estimates, (6, 6)),
        "closed loops [ns]": np.array([t for e in estimates for t in e.closed_loops_ns], np.int64).reshape(-1, 2),
        "events": np.array(["; ".join(e.events) for e in estimates], dtype="U"),
    }


def rows(values: Iterable[Any], states: Sequence[Any], shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    """Return one array of a shape for each state, NaN where there is no state or it lacks the value."""
    table = np.full((len(states), *shape), np.nan)
    for row, value in zip((i for i, s in enumerate(states) if s is not None), values, strict=True):
        if value is not None:
            table[row] = value
    return table


def flight(folder: Path) -> Arrays:
    """Return what a recording of the EuRoC layout holds: IMU, images, truth and calibration, but no text."""
    mav0 = folder / "mav0"
    imu, truth = table(mav0 / "imu0"), table(mav0 / "state_groundtruth_estimate0")
    arrays: Arrays = {
        "IMU time [ns]": times(mav0 / "imu0"),
        "gyroscope [rad/s]": imu[:, 1:4],
        "accelerometer [m/s²]": imu[:, 4:7],
        "truth time [ns]": times(mav0 / "state_groundtruth_estimate0"),
        **{name: truth[:, columns] for name, columns in _TRUTH_COLUMNS.items()},
        "frame truth": table(mav0 / "frame_groundtruth0"),
        "calibration": calibration(mav0),
    }
    for images in sorted(path for path in mav0.iterdir() if (path / "data").is_dir()):
        files = sorted((images / "data").glob("*.png"), key=lambda file: int(file.stem))
        arrays[f"{images.name} time [ns]"] = np.array([int(file.stem) for file in files], dtype=np.int64)
        arrays[f"{images.name} images"] = np.array([image_hash(file) for file in files], dtype="U64")
    return arrays


def table(folder: Path) -> npt.NDArray[np.float64]:
    """Return the numbers (N, M) of a table of the EuRoC layout."""
    return np.loadtxt(folder / "data.csv", delimiter=",", ndmin=2)


def times(folder: Path) -> npt.NDArray[np.int64]:
    """Return the time stamps (N,) [ns] of a table of the EuRoC layout."""
    return np.loadtxt(folder / "data.csv", delimiter=",", usecols=0, dtype=np.int64, ndmin=1)


def calibration(mav0: Path) -> npt.NDArray[np.float64]:
    """Return all numbers of the calibration files in the order of the files' names and lines; comments do not count."""
    files = sorted((*mav0.glob("*/sensor.yaml"), *mav0.glob("body.yaml")))
    lines = (
        line.partition("#")[0].partition("comment:")[0] for file in files for line in file.read_text().splitlines()
    )
    return np.array([float(number) for line in lines for number in _NUMBER.findall(line)])


def image_hash(file: Path) -> str:
    """Return the hash of an image's pixels, whatever their compression."""
    image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise ValueError(f"{file}: no image can be read")
    return hashlib.sha256(f"{image.dtype} {image.shape}".encode() + image.tobytes()).hexdigest()


COMPUTATIONS: dict[str, Callable[[list[Path], Path], Arrays]] = {
    "check": lambda paths, code: {},
    "estimate": lambda paths, code: estimate(paths[0]),
    "eqvio": lambda paths, code: eqvio(),
    "slam": lambda paths, code: slam(paths[0]),
    "sfm": lambda paths, code: sfm(paths[0]),
    "scores": lambda paths, code: scores(paths[0]),
    "flight": lambda paths, code: flight(paths[0]),
    "on-estimate": lambda paths, code: on_estimate(),
    "environments": lambda paths, code: environments(),
    "vector-environments": lambda paths, code: environments(vector=True),
    "vio-environments": lambda paths, code: environments(on_estimate=True, steps=80),
    "policies": lambda paths, code: policies(code),
    "ate": lambda paths, code: ates(paths),
}
"""What can be computed, from the paths of recordings and the folder of the revision's code."""


def main() -> None:
    """Compute one set of arrays and write them into a file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=tuple(COMPUTATIONS))
    parser.add_argument("paths", type=Path, nargs="*", help="Recordings to read.")
    parser.add_argument("--code", type=Path, required=True, help="Folder that dronevio must be imported from.")
    parser.add_argument("--out", type=Path, help="File for the arrays (.npz).")
    options = parser.parse_args()
    check_code(options.code)
    arrays = COMPUTATIONS[options.what](options.paths, options.code)
    if options.out is not None:
        np.savez_compressed(options.out, **arrays)  # type: ignore[arg-type]


if __name__ == "__main__":
    main()
