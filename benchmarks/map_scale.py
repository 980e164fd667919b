"""The scale of adjusted maps with one camera: what makes it wrong, as a Markdown table and a picture.

A recording is estimated once. The bundle adjustment of its map is then repeated with parts of the measurements replaced
by simulated ones: exact tracks of the landmarks, with 0.05 px of noise, along the path as recorded or along a smooth
path through it; and an IMU that is simulated along the smooth path, perfect or with multiples of the noise of its data
sheet. Last, the camera is shaken from keyframe to keyframe, which the simulated IMU does not feel. Each problem is
solved with the scale by the IMU and with the scale by the odometry
(`dronevio.estimator.slam.adjustment.bundle_adjustment`)::

    .venv/bin/dronevio fly --scenario room-square-laps --seed 0 --rig euroc-stereo --out recordings/laps
    .venv/bin/python benchmarks/map_scale.py recordings/laps --picture docs/images/map-scale.svg
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import numpy.typing as npt
import tyro
from matplotlib.figure import Figure
from measuring import opened, print_as_made

from dronevio.api import estimate
from dronevio.estimator.backend.observations import ObservationTable
from dronevio.estimator.backend.triangulation import triangulate
from dronevio.estimator.slam.adjustment.bundle_adjustment import (
    AdjustmentConfig,
    AdjustmentInputs,
    Scale,
    adjust,
    map_observations,
    triangulated,
)
from dronevio.estimator.slam.visual_slam import VisualSlam
from dronevio.eval import colours
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.scores import score_trajectory
from dronevio.models.errors import ConfigError
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.models.state import Trajectory
from dronevio.sim.inertial.imu import ImuErrors
from dronevio.sim.paths.spline import SmoothMotion

TRACK_SIGMA_PX = 0.05
"""Standard deviation of the simulated tracks [px]."""
NOISES = (0.0, 1.0, 3.0, 10.0)
"""Noise of the simulated IMUs relative to the data sheet."""
SHAKES_MM = (0.0, 0.5, 1.0, 2.0, 4.0)
"""Standard deviations of the position of the shaken camera [mm]."""


@dataclass(frozen=True)
class MapScaleCommand:
    """Measure the scale of adjusted maps."""

    recordings: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Recordings with ground truth."""
    picture: Path | None = None
    """Picture of the scale over the shaking of the camera, of the first recording."""
    seed: int = 0
    """Seed of the simulated measurements."""


@dataclass(frozen=True)
class Problem:
    """A bundle adjustment and the truth by which its result is judged."""

    name: str
    """What is simulated."""
    inputs: AdjustmentInputs
    """Measurements of the map."""
    truth: Trajectory
    """The true path."""

    def scale_error_percent(self, scale: Scale) -> float:
        """Return the error of the scale of the adjusted map [%]."""
        poses = adjust(self.inputs, AdjustmentConfig(), scale).poses
        t_ns = np.array([keyframe.t_ns for keyframe in self.inputs.keyframes])
        Ts = np.stack([poses[keyframe.number] for keyframe in self.inputs.keyframes])
        path = Trajectory(t_ns, Ts[:, :3, 3], quat_wxyz_from_matrix(Ts[:, :3, :3]))
        error = score_trajectory(self.truth, path, t_ns).scores.scale_error_percent
        return float("nan") if error is None else error


def measured(path: Path) -> tuple[AdjustmentInputs, Trajectory]:
    """Return the measurements of the final map of a recording by one camera, and the true path.

    Raises:
        ConfigError: There is no loop.
        InputError: The recording cannot be read.
    """
    recording, truth = opened(path, 1)
    slam = VisualSlam(recording.rig)
    run = estimate(recording, slam)
    if run.map is None or not len(run.map.closed):
        raise ConfigError(f"no loop in {recording.name}; expected a flight that comes back")
    inputs = slam.adjustment_inputs()
    slam.close()
    return inputs, truth


def with_exact_tracks(inputs: AdjustmentInputs, truth: Trajectory, seed: int, shake_m: float = 0.0) -> AdjustmentInputs:
    """Return measurements whose landmarks are seen where they are, but for noise of `TRACK_SIGMA_PX`.

    Args:
        inputs: The measurements; landmarks are triangulated from their observations at the true poses.
        truth: The true path, whose frame is the map frame from now on.
        seed: Seed of the noise.
        shake_m: Standard deviation by which the camera is moved from keyframe to keyframe [m].
    """
    rng, (T_imu_cam,) = np.random.default_rng(seed), inputs.calibration.Ts_imu_cam
    true, rows = interpolate(truth, np.array([keyframe.t_ns for keyframe in inputs.keyframes]))
    keyframes = [inputs.keyframes[row] for row in rows]
    velocities = np.gradient(true.p_world_imu, true.t_s, axis=0)
    Ts = {keyframe.number: T @ T_imu_cam for keyframe, T in zip(keyframes, true.Ts_world_imu, strict=True)}
    shaken = {number: T[:3, 3] + shake_m * rng.normal(size=3) for number, T in Ts.items()}
    placed = [
        replace(keyframe, T_map_imu=T, velocity_m_s=v)
        for keyframe, T, v in zip(keyframes, true.Ts_world_imu, velocities, strict=True)
    ]
    inputs = replace(
        inputs, keyframes=placed, loops=[loop for loop in inputs.loops if {loop.first, loop.second} <= Ts.keys()]
    )
    # Landmarks by the recorded observations and the true poses
    observed, _ = triangulated(map_observations(inputs, AdjustmentConfig()), inputs, AdjustmentConfig())
    _, starts, counts = np.unique(observed.landmark, return_index=True, return_counts=True)
    T = np.stack([Ts[number] for number in observed.keyframe.tolist()])
    points = np.repeat(triangulate(starts, T[:, :3, :3], T[:, :3, 3], observed.xy).points, counts, axis=0)
    # Their images at the shaken poses
    centres = np.stack([shaken[number] for number in observed.keyframe.tolist()])
    in_cam = np.einsum("nji,nj->ni", T[:, :3, :3], points - centres)
    sigma = TRACK_SIGMA_PX / float(inputs.calibration.focal_px[0])
    exact = replace(observed, xy=in_cam[:, :2] / in_cam[:, 2:] + sigma * rng.normal(size=(len(points), 2)))
    return _with_observations(inputs, exact)


def _with_observations(inputs: AdjustmentInputs, observed: ObservationTable) -> AdjustmentInputs:
    """Return measurements with other observations, those of loops included, whose scale is one pixel sigma."""
    observed = replace(observed, sigma_scale=np.ones(len(observed)))
    keyframes = [replace(k, observations=observed[observed.keyframe == k.number]) for k in inputs.keyframes]
    return replace(inputs, keyframes=keyframes, loops=())


def with_simulated_imu(
    inputs: AdjustmentInputs, motion: SmoothMotion, t_ns: npt.NDArray[np.int64], noise: float, seed: int
) -> AdjustmentInputs:
    """Return measurements with an IMU that is simulated along a path, and with its true noise.

    Args:
        inputs: The measurements.
        motion: The path.
        t_ns: Times of the samples [ns].
        noise: White noise relative to the data sheet.
        seed: Seed of the noise.
    """
    sheet = inputs.imu_model
    gyro, accel = noise * sheet.gyro_noise_density, noise * sheet.accel_noise_density
    model = ImuModel(
        name=f"{sheet.name}, simulated",
        rate_hz=sheet.rate_hz,
        gyro_noise_density=gyro,
        gyro_random_walk=0.0,
        accel_noise_density=accel,
        accel_random_walk=0.0,
    )
    imu: ImuSamples = ImuErrors(model, np.random.default_rng(seed)).add_to(motion.points(t_ns))[0]
    floor = max(noise, 1.0)
    params = inputs.params.with_noise(floor * sheet.gyro_noise_density, floor * sheet.accel_noise_density)
    return replace(inputs, imu=imu, params=params)


def problems(inputs: AdjustmentInputs, truth: Trajectory, seed: int) -> Iterator[Problem]:
    """Yield the measurements of a flight with more and more of them simulated."""
    motion = SmoothMotion.through(truth)
    smooth = motion.trajectory(truth.t_ns)
    yield Problem("images, recorded IMU", inputs, truth)
    on_path, on_smooth = (with_exact_tracks(inputs, path, seed) for path in (truth, smooth))
    yield Problem("exact tracks on the recorded path, recorded IMU", on_path, truth)
    for noise in NOISES:
        name = "perfect IMU" if noise == 0.0 else f"simulated IMU, noise x {noise:g}"
        yield Problem(
            f"exact tracks on the recorded path, {name}",
            with_simulated_imu(on_path, motion, truth.t_ns, noise, seed),
            truth,
        )
        yield Problem(
            f"exact tracks on the smooth path, {name}",
            with_simulated_imu(on_smooth, motion, truth.t_ns, noise, seed),
            smooth,
        )


def shaken(inputs: AdjustmentInputs, truth: Trajectory, seed: int) -> Iterator[tuple[float, Problem]]:
    """Yield flights with a shaking camera [mm], with the noise of the IMU that the images then suggest.

    Velocities of keyframes Δt apart err by √2 σ / Δt, which is a white noise density of √2 σ / Δt^1.5.
    """
    motion = SmoothMotion.through(truth)
    smooth, sheet = motion.trajectory(truth.t_ns), inputs.imu_model.accel_noise_density
    interval_s = float(np.median(np.diff([keyframe.t_ns for keyframe in inputs.keyframes]))) * 1e-9
    for shake_mm in SHAKES_MM:
        tracks = with_exact_tracks(inputs, smooth, seed, 1e-3 * shake_mm)
        measured = with_simulated_imu(tracks, motion, truth.t_ns, 1.0, seed)
        density = float(np.hypot(sheet, np.sqrt(2.0) * 1e-3 * shake_mm / interval_s**1.5))
        params = measured.params.with_noise(measured.params.gyro_variance**0.5, density)
        name = f"camera shaken by {shake_mm:g} mm, noise x {density / sheet:.1f} by the images"
        yield shake_mm, Problem(name, replace(measured, params=params), smooth)


def draw(path: Path, errors: list[tuple[float, float, float]]) -> None:
    """Draw the scale errors [%] by the IMU and by the odometry over the shaking [mm]."""
    figure = Figure(figsize=(6.0, 3.0), layout="constrained")
    ax = figure.subplots()
    shake_mm, by_imu, by_odometry = np.array(errors).T
    ax.plot(shake_mm, by_imu, "o-", color=colours.REJECTED_LOOP, label="scale by the IMU, every 0.2 s")
    ax.plot(shake_mm, by_odometry, "o-", color=colours.LOOP, label="scale by the odometry")
    ax.axhline(0.0, color="0.7", linewidth=0.8)
    ax.set_xlabel("shaking of the camera that the IMU does not feel [mm]")
    ax.set_ylabel("scale error of the map [%]")
    ax.legend(frameon=False)
    figure.savefig(path, metadata={"Date": None} if path.suffix == ".svg" else None)


def rows_of(
    cases: Iterable[tuple[float | None, Problem]], errors: list[tuple[float, float, float]]
) -> Iterator[dict[str, str]]:
    """Yield the rows of problems, and append the shaking [mm] and the errors [%] of those with a shaking camera."""
    for shake_mm, problem in cases:
        by_imu, by_odometry = (problem.scale_error_percent(scale) for scale in Scale)
        if shake_mm is not None:
            errors.append((shake_mm, by_imu, by_odometry))
        yield {
            "measurements": problem.name,
            "scale by the IMU: error [%]": f"{by_imu:+.2f}",
            "by the odometry [%]": f"{by_odometry:+.2f}",
        }


def main(command: MapScaleCommand) -> None:
    """Print a table for each recording, and draw the picture.

    Raises:
        ConfigError: A recording has no ground truth or no loop.
        InputError: A recording cannot be read.
    """
    for number, path in enumerate(command.recordings):
        inputs, truth = measured(path)
        print(f"\n{path.name}: {len(inputs.keyframes)} keyframes\n")
        errors = list[tuple[float, float, float]]()
        cases = chain(
            ((None, each) for each in problems(inputs, truth, command.seed)), shaken(inputs, truth, command.seed)
        )
        print_as_made(rows_of(cases, errors))
        if command.picture is not None and number == 0:
            draw(command.picture, errors)


if __name__ == "__main__":
    main(tyro.cli(MapScaleCommand, description=__doc__))
