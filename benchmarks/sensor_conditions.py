"""Conditions of a flight that its calibration does not state: noise of the IMU, errors of the cameras, and image size.

Of two kinds are those of the IMU: the samples differ from what the calibration states (three times the noise, coloured
noise, vibration, biases that follow the temperature), or the calibration states a tenth or ten times the noise of the
same samples. Errors of the cameras' calibration are drawn from the prior of the online calibration, over which its
covariances hold. A condition is a function of a recording and of a generator of random numbers.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import numpy.typing as npt
from faulty_imus import Fault, of_imu, with_values
from measuring import ChangedRecording
from scipy.signal import lfilter

from dronevio.estimator.calibration.config import CalibrationConfig
from dronevio.models.arrays import Array
from dronevio.models.imu import ImuModel, ImuSamples
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import exp_so3

NOISE_FACTOR = 3.0
"""Noise densities and random walks of a noisy IMU, relative to those that are stated."""
COLOUR_S, COLOUR_FACTOR = 0.1, 5.0
"""Time constant of coloured noise [s], and its density at low frequencies relative to that of the data sheet."""
VIBRATION_HZ, VIBRATION = 87.0, (0.1, 5.0)
"""Frequency of a vibration, and its amplitudes [rad/s, m/s²]."""
PHASE_WALK_RAD = 0.1
"""Random walk of the phase of the vibration, per sample [rad]."""
WARMING_S, WARMING = 30.0, (0.005, 0.1)
"""Time constant of a warming IMU [s], and the change of the biases of each axis [rad/s, m/s²]."""


def _added(recording: ChangedRecording, of: Callable[[ImuSamples, ImuModel], tuple[Array, Array]]) -> ChangedRecording:
    """Return a recording with errors (N, 3) added to gyroscope and accelerometer."""
    samples = recording.imu
    gyro, accel = of(samples, recording.rig.imu)
    return replace(recording, imu=with_values(samples, samples.gyro_rad_s + gyro, samples.accel_m_s2 + accel))


def _elapsed_s(samples: ImuSamples) -> Array:
    return np.asarray((samples.t_ns - samples.t_ns[0]) * 1e-9)


def noisy(recording: ChangedRecording, rng: np.random.Generator) -> ChangedRecording:
    """Return a recording whose white noise and random walks are `NOISE_FACTOR` times those that are stated."""
    extra = math.sqrt(NOISE_FACTOR**2 - 1.0)

    def errors(samples: ImuSamples, imu: ImuModel) -> tuple[Array, Array]:
        def error(density: float, walk: float) -> Array:
            white, steps = rng.normal(size=(2, len(samples), 3))
            walked = np.cumsum(steps, axis=0) * walk / math.sqrt(imu.rate_hz)
            return np.asarray(extra * (density * math.sqrt(imu.rate_hz) * white + walked))

        return (
            error(imu.gyro_noise_density, imu.gyro_random_walk),
            error(imu.accel_noise_density, imu.accel_random_walk),
        )

    return _added(recording, errors)


def coloured(recording: ChangedRecording, rng: np.random.Generator) -> ChangedRecording:
    """Return a recording with noise of the first order (Gauss-Markov) added."""

    def errors(samples: ImuSamples, imu: ImuModel) -> tuple[Array, Array]:
        kept = math.exp(-1.0 / (imu.rate_hz * COLOUR_S))
        states = lfilter([math.sqrt(1.0 - kept**2)], [1.0, -kept], rng.normal(size=(len(samples), 6)), axis=0)
        sigmas = COLOUR_FACTOR * np.array([imu.gyro_noise_density, imu.accel_noise_density]) / math.sqrt(2.0 * COLOUR_S)
        return sigmas[0] * states[:, :3], sigmas[1] * states[:, 3:]

    return _added(recording, errors)


def vibrating(recording: ChangedRecording, rng: np.random.Generator) -> ChangedRecording:
    """Return a recording with a vibration of wandering phase and random direction."""

    def errors(samples: ImuSamples, _: ImuModel) -> tuple[Array, Array]:
        walk = np.cumsum(rng.normal(0.0, PHASE_WALK_RAD, len(samples)))
        shake = np.sin(2.0 * np.pi * (VIBRATION_HZ * _elapsed_s(samples) + rng.random()) + walk)
        axes = rng.normal(size=(2, 3))
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        return VIBRATION[0] * shake[:, None] * axes[0], VIBRATION[1] * shake[:, None] * axes[1]

    return _added(recording, errors)


def warming(recording: ChangedRecording, rng: np.random.Generator) -> ChangedRecording:
    """Return a recording whose biases follow the temperature of an IMU that warms up."""

    def errors(samples: ImuSamples, _: ImuModel) -> tuple[Array, Array]:
        signs, rise = rng.choice([-1.0, 1.0], (2, 3)), 1.0 - np.exp(-_elapsed_s(samples) / WARMING_S)
        return WARMING[0] * rise[:, None] * signs[0], WARMING[1] * rise[:, None] * signs[1]

    return _added(recording, errors)


def stated(factor: float) -> Fault:
    """Return the condition of a calibration that states noise and random walks times a factor."""

    def changed(recording: ChangedRecording, _: np.random.Generator) -> ChangedRecording:
        imu = recording.rig.imu
        of_imu_model = replace(
            imu,
            gyro_noise_density=factor * imu.gyro_noise_density,
            accel_noise_density=factor * imu.accel_noise_density,
            gyro_random_walk=factor * imu.gyro_random_walk,
            accel_random_walk=factor * imu.accel_random_walk,
        )
        return replace(recording, rig=replace(recording.rig, imu=of_imu_model))

    return changed


def miscalibrated(recording: ChangedRecording, rng: np.random.Generator) -> ChangedRecording:
    """Return a recording whose cameras have calibration errors, drawn from the prior of the online calibration."""
    prior, is_single = CalibrationConfig(), len(recording.rig.cameras) == 1

    def wrong(camera: RigCamera) -> RigCamera:
        m, normal = camera.model, rng.normal
        ratio = 1.0 + prior.focal.sigma * normal()
        centre_px = prior.principal.sigma * normal(size=2) * (m.fx, m.fy)
        k1 = m.distortion[0] + prior.radial.sigma * normal()
        T_imu_cam = camera.T_imu_cam.copy()
        T_imu_cam[:3, :3] = exp_so3(prior.rotation.sigma * normal(size=3)) @ T_imu_cam[:3, :3]
        T_imu_cam[:3, 3] += 0.0 if is_single else prior.position_sigma_m * normal(size=3)
        model = replace(
            m,
            fx=ratio * m.fx,
            fy=ratio * m.fy,
            cx=m.cx + centre_px[0],
            cy=m.cy + centre_px[1],
            distortion=(k1, *m.distortion[1:]),
        )
        return replace(camera, model=model, T_imu_cam=T_imu_cam)

    rig = recording.rig
    offset_s = rig.time_offset_s + prior.time_offset.sigma * rng.normal()
    return replace(recording, rig=replace(rig, cameras=tuple(map(wrong, rig.cameras)), time_offset_s=offset_s))


def half_size(recording: ChangedRecording, _: np.random.Generator) -> ChangedRecording:
    """Return a recording whose images have half the width and height, each pixel the mean of four."""

    def half(image: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint8]:
        h, w = image.shape[0] // 2, image.shape[1] // 2
        fours = image[: 2 * h, : 2 * w].reshape(h, 2, w, 2)
        return np.asarray(np.rint(fours.mean(axis=(1, 3))), np.uint8)

    def smaller(camera: RigCamera) -> RigCamera:
        m = camera.model
        model = replace(
            m,
            width=m.width // 2,
            height=m.height // 2,
            fx=0.5 * m.fx,
            fy=0.5 * m.fy,
            cx=0.5 * m.cx - 0.25,
            cy=0.5 * m.cy - 0.25,
        )
        return replace(camera, model=model)

    cameras = tuple(map(smaller, recording.rig.cameras))
    return replace(recording.with_images(half), rig=replace(recording.rig, cameras=cameras))


CONDITIONS: Mapping[str, Fault] = {
    "as-is": of_imu(lambda samples, _: samples),
    "noise-3x": noisy,
    "coloured": coloured,
    "vibrating": vibrating,
    "warming": warming,
    "stated-10x": stated(10.0),
    "stated-tenth": stated(0.1),
    "half-size": half_size,
    "miscalibrated": miscalibrated,
}
"""Conditions by name."""
