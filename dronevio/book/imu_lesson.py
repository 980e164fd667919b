"""What ``dronevio book imu`` prints: every value with its unit and its meaning, or the same values as JSON."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from dronevio.book.lesson import print_lesson, print_paragraph
from dronevio.cli.terminal import print_table
from dronevio.estimator.book.drift import DriftStudy
from dronevio.estimator.book.imu import ImuExperiment
from dronevio.estimator.book.loop import LoopFlight
from dronevio.estimator.book.visual_inertial import CameraStudy

_CODE = "dronevio.estimator.book"


def print_flight(flight: LoopFlight) -> None:
    """Print the motion, and the distribution of the IMU samples over the factors."""
    counts = ", ".join(map(str, flight.factor_samples))
    unused = flight.samples - sum(flight.factor_samples)
    print_lesson(
        "1. The flight",
        "7.4.1 (motion: 7.2)",
        f"{_CODE}.loop",
        (
            ("radius", f"{flight.radius_m:.3f}", "m", "v/ω: a constant twist is a circle, 2 m/s by 30 °/s"),
            (
                "arc",
                f"{math.degrees(flight.arc_rad):.0f}",
                "°",
                f"ω t: the part of the circle in {flight.duration_s} s",
            ),
            ("IMU samples", f"{flight.samples}", "1", f"{flight.imu_rate_hz:g} Hz for {flight.duration_s} s"),
            ("IMU factors", f"{len(flight.factor_samples)}", "1", f"samples in each: {counts}; unused: {unused}"),
        ),
    )
    if flight.counting == "book":
        print_paragraph(
            """The loop of the book ends a factor after sample 5, 10 and so on. As it counts from 0, its first factor
            has six samples, every estimated state is one sample later than the time of its initial value, and the last
            four samples are unused. The option --counting equal makes seven factors with five samples each."""
        )


def print_solution(experiment: ImuExperiment) -> None:
    """Print the graph and its solutions, in batch and incremental."""
    e, t_s = experiment, float(experiment.t_s[-1])
    held_m = e.flight.speed_m_s * e.flight.pitch_rate_rad_s * math.radians(1.5) * 0.5 * t_s**2
    print_lesson(
        "2. The factor graph and its solution",
        "7.4.1",
        f"{_CODE}.imu, {_CODE}.optimization",
        (
            ("factors", f"{len(e.factors)}", "1", "priors on pose, velocity and bias; all others are IMU factors"),
            ("unknowns", f"{9 * len(e.t_s) + 6}", "1", "9 for each state, 6 for the bias: as many as residuals"),
            ("error before", f"{e.initial_error:.4g}", "1", "½ Σ (residual/σ)² at the initial values"),
            ("error after", f"{e.final_error:.1e}", "1", "the same at the solution; zero except for rounding"),
            ("iterations", f"{e.iterations}", "1", "of Levenberg-Marquardt, until the error stops decreasing"),
            ("iSAM2 updates", f"{e.incremental_updates}", "1", "one for each state, then until the solution converges"),
            (
                "batch − iSAM2",
                f"{e.incremental_difference:.1e}",
                "rad, m, m/s",
                "largest difference in local coordinates: the same solution",
            ),
            (
                "to integration",
                f"{e.dead_reckoning_difference_m:.1e}",
                "m",
                "distance from plain integration: the solution is dead reckoning",
            ),
            ("distance to truth", f"{e.drift_m:.3f}", "m", f"of the last state, after {t_s:.1f} s"),
            (
                "without noise",
                f"{e.noise_free_drift_m:.3f}",
                "m",
                "the same for noise-free samples: the effect of 10 Hz",
            ),
        ),
    )
    print_paragraph(
        f"""Why is the error zero and the position wrong by {100.0 * e.drift_m:.0f} cm? The error of a graph
        compares the states with the measurements, not with the truth. The initial error is large because the factors
        are precise: initial values are wrong by 0.1 rad and 0.1 m, where a factor expects 0.1 mrad and 0.3 mm. There
        are as many residuals as unknowns, so that states exist that agree with all measurements exactly, wrong
        measurements included. Here the sampling causes more error than the noise: at 30 °/s the acceleration vω turns
        by 3° until the next sample, and a sample is held until then, so that its direction lags by 1.5° on average. The
        resulting error is about vω · 1.5° · t²/2 = {held_m:.2f} m after {t_s:.1f} s, and somewhat less because
        its direction turns as well."""
    )


def print_covariance(experiment: ImuExperiment) -> None:
    """Print the standard deviation of the path by state and by source."""
    noise_m = np.sqrt(np.trace(experiment.noise_covariance_m2, axis1=1, axis2=2))
    print_table(
        f"3. The covariance of the path\nBook: section 7.4.1. Code: {_CODE}.optimization (LinearizedGraph)",
        ("state", "time [s]", "σ of position [m]", "of which IMU noise [m]"),
        [
            (f"x{i}", f"{t_s:.1f}", f"{sigma_m:.3f}", f"{noise:.4f}")
            for i, (t_s, sigma_m, noise) in enumerate(zip(experiment.t_s, experiment.sigma_m, noise_m, strict=True))
        ],
    )
    explained = {
        "initial orientation": "tilt: gravity is integrated along the path, g σ t²/2 in two directions",
        "initial position": "the whole path is shifted, √3 σ",
        "initial velocity": "√3 σ t",
        "accelerometer bias": "about σ t²/2 in each direction",
        "gyroscope bias": "the tilt grows with time: g σ t³/6 and more",
        "IMU noise": "what remains if the first state and the bias are exactly known",
    }
    print_lesson(
        f"Sources of σ of x{len(experiment.t_s) - 1}; their squares add up to {experiment.sigma_m[-1]:.2f}²",
        "7.4.1",
        f"{_CODE}.imu",
        [(source.name, f"{source.sigma_m:.3f}", "m", explained[source.name]) for source in experiment.sources],
    )
    print_paragraph(
        f"""The book gives all priors σ = 0.1. For a position that is 10 cm; for a tilt it is 5.7°, and for a gyroscope
        5.7 °/s, as large as for the cheapest ones without calibration. These priors, not the IMU, make the path
        uncertain by metres. In this experiment the first state is exact, but no factor contains this information. A
        note on the computation: the condition number of the whitened Jacobian A is {experiment.condition:.1e}; the
        normal equations AᵀA square it. With Cholesky factorization, GTSAM 4.3 stops at an error of 1e-4; QR
        factorization of A reaches zero."""
    )


def print_drift(studies: Mapping[str, DriftStudy]) -> None:
    """Print the spread of dead reckoning for each IMU, measured and predicted."""
    any_study = next(iter(studies.values()))
    runs, t_s = len(any_study.error_m), any_study.t_s[-1]
    print_table(
        f"4. The drift after {t_s:g} s, {runs} flights for each IMU\n"
        f"Book: section 7.4.1 (noise models: 7.2). Code: {_CODE}.drift",
        (
            *("IMU", "measured [m]", "predicted [m]", "ratio", "±"),
            *("gyro noise", "accel noise", "gyro walk", "accel walk", "uncalibrated [m]"),
        ),
        [
            (
                name,
                f"{study.rms_m[-1]:.2f}",
                f"{study.sigma_m[-1]:.2f}",
                f"{study.ratio[-1]:.3f}",
                f"{study.ratio_sigma:.3f}",
                *(f"{100.0 * share:.0f} %" for share in (study.source_sigma_m / study.sigma_m[-1]) ** 2),
                f"{study.uncalibrated_rms_m:.0f}",
            )
            for name, study in studies.items()
        ],
    )
    print_paragraph(
        """Measured: root mean square distance from the true position over all flights, each with white noise and biases
        that walk from an exactly known start. Predicted: the covariance of the state, propagated forward in time.
        Ratio: measured by predicted, 1 if the theory is right, with its standard deviation (±) for this number of
        flights. The percentages are shares of the predicted variance by source. As the book states, the estimate drifts
        without external measurements: by metres in a minute even with an expensive IMU. The errors grow like t^1.5 to
        t^3.5, so that half the duration gives much less than half the error."""
    )
    print_paragraph(
        f"""Uncalibrated: measured on the same flights with unknown turn-on biases. The MPU-6050 drifts little only
        because its bias is known at the start: its gyroscope has less white noise than most, but a turn-on bias of
        {math.degrees(studies["MPU-6050"].imu.gyro_turn_on_bias_rad_s):.1f} °/s."""
    )


def print_camera(camera: CameraStudy, name: str) -> None:
    """Print errors and standard deviations with and without the camera."""
    t_s = f"{camera.t_s[-1]:g} s"
    print_lesson(
        f"5. The same IMU factors with a camera: IMU {name}, {len(camera.error_m)} flights",
        "7.4.2, 7.4.3",
        f"{_CODE}.visual_inertial",
        (
            ("IMU alone", f"{camera.imu_rms_m[-1]:.2f}", "m", f"RMS error of the position after {t_s}"),
            ("IMU alone, theory", f"{camera.imu_sigma_m[-1]:.2f}", "m", "its predicted standard deviation"),
            ("with camera", f"{camera.rms_m[-1]:.3f}", "m", f"RMS error of the position after {t_s}"),
            (
                "with camera, theory",
                f"{camera.rms_sigma_m[-1]:.3f}",
                "m",
                "its standard deviation by the marginal covariance",
            ),
            (
                "largest error",
                f"{camera.rms_m.max():.3f}",
                "m",
                "RMS error with camera at the worst time of the flight",
            ),
            ("landmarks", f"{camera.landmarks:.0f}", "1", "points in the graph at the end, mean of the flights"),
            ("observations", f"{camera.observations:.0f}", "1", "projection factors at the end, mean of the flights"),
            (
                "normalized error",
                f"{camera.normalized_error:.3f}",
                "1",
                "2 · error/redundancy: 1 if the noise models are right",
            ),
        ),
    )
    print_paragraph(
        """Every estimate uses the measurements before it only. One round takes 12 s. During the first round the error
        grows slowly, because each new landmark is located relative to those before it. From the second round on, the
        drone observes landmarks that are already in the graph, and the error remains at a few centimetres."""
    )


def experiment_json(experiment: ImuExperiment) -> dict[str, Any]:
    """Return what the experiment measures as a JSON document."""
    return {
        "counting": experiment.flight.counting,
        "samples": list(experiment.flight.factor_samples),
        "states": len(experiment.t_s),
        "factors": len(experiment.factors),
        "initial_error": experiment.initial_error,
        "final_error": experiment.final_error,
        "iterations": experiment.iterations,
        "incremental_difference": experiment.incremental_difference,
        "incremental_updates": experiment.incremental_updates,
        "radius_m": experiment.flight.radius_m,
        "arc_rad": experiment.flight.arc_rad,
        "drift_m": experiment.drift_m,
        "noise_free_drift_m": experiment.noise_free_drift_m,
        "sigma_m": experiment.sigma_m.tolist(),
        "sources_m": {source.name: source.sigma_m for source in experiment.sources},
    }


def studies_json(studies: Mapping[str, DriftStudy], camera: CameraStudy) -> dict[str, Any]:
    """Return what the drift study and the study with a camera measure as a JSON document."""
    return {
        "drift": {
            name: {
                "runs": len(study.error_m),
                "duration_s": float(study.t_s[-1]),
                "measured_m": float(study.rms_m[-1]),
                "predicted_m": float(study.sigma_m[-1]),
                "ratio": float(study.ratio[-1]),
                "ratio_sigma": study.ratio_sigma,
                "uncalibrated_m": study.uncalibrated_rms_m,
            }
            for name, study in studies.items()
        },
        "camera": {
            "runs": len(camera.error_m),
            "t_s": camera.t_s.tolist(),
            "rms_m": camera.rms_m.tolist(),
            "sigma_m": camera.rms_sigma_m.tolist(),
            "imu_rms_m": camera.imu_rms_m.tolist(),
            "imu_sigma_m": camera.imu_sigma_m.tolist(),
            "normalized_error": camera.normalized_error,
        },
    }
