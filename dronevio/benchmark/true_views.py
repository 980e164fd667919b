"""True views of the cameras of simulated flights: poses and distances of surfaces, for the measurement of revisits.

Distances are those of the geometry of the world along a grid of rays (`dronevio.sim.ray_casting`). A recording needs no
depth images: its file ``scenario.json`` names the world and its seed.
"""

from pathlib import Path

import numpy as np
import numpy.typing as npt

from dronevio.eval.metrics.association import nearest_rows
from dronevio.eval.metrics.loops import FlightRevisits
from dronevio.eval.metrics.pairs import path_lengths_m
from dronevio.eval.metrics.revisits import Views, find_revisits, grid_pixels
from dronevio.models.errors import InputError
from dronevio.models.imu import GRAVITY_M_S2, Times
from dronevio.models.recordings.frame_truth import FRAME_TRUTH_FILE, read_frame_truth
from dronevio.models.recordings.open import open_recording
from dronevio.models.recordings.scenario_file import world_of
from dronevio.models.rig import RigCamera
from dronevio.models.rotation import pose_matrix, quat_wxyz_from_matrix
from dronevio.models.state import Trajectory
from dronevio.sim.cameras.interpolation import interpolated_poses
from dronevio.sim.flight import Flight, plant_of, reference_of
from dronevio.sim.paths.path import attitude
from dronevio.sim.ray_casting import RayCaster
from dronevio.sim.scenario import Scenario

INTERVAL_S = 0.25
"""Default time between the frames of a flight that are examined [s]."""


def flight_views(flight: Flight, interval_s: float = INTERVAL_S) -> Views:
    """Return the true views of the first camera of a flight, of frames at about regular intervals.

    Args:
        flight: A simulated flight; images are not needed.
        interval_s: Time between the frames, at least that of all frames [s].
    """
    camera, scenario = flight.true_rig.cameras[0], flight.scenario
    exposed_ns = flight.schedule.exposed_ns[:: max(1, round(interval_s * camera.rate_hz))]
    return true_views(scenario.world, scenario.seed_of_world, flight.truth, camera, exposed_ns)


def planned_views(scenario: Scenario, interval_s: float = INTERVAL_S) -> Views:
    """Return the views of the first camera of a scenario along its planned trajectory, without a simulated flight.

    The flown trajectory deviates from the planned one by centimetres.

    Args:
        scenario: The scenario.
        interval_s: Time between the frames [s].

    Raises:
        ConfigError: The plan does not fit into the world.
    """
    rig = scenario.true_rig
    reference = reference_of(scenario, plant_of(scenario))
    rows = np.arange(0, len(reference), max(1, round(interval_s * 1e9 / reference.t_ns[1])))
    thrust = reference.acceleration_m_s2 + [0.0, 0.0, GRAVITY_M_S2]
    Ts_world_vehicle = pose_matrix(attitude(thrust, reference.yaw_rad), reference.position_m)
    Ts_world_imu = Ts_world_vehicle @ rig.T_vehicle_imu
    truth = Trajectory(reference.t_ns, Ts_world_imu[:, :3, 3], quat_wxyz_from_matrix(Ts_world_imu[:, :3, :3]))
    return true_views(scenario.world, scenario.seed_of_world, truth, rig.cameras[0], reference.t_ns[rows])


def recording_views(folder: Path, t_ns: Times) -> Views:
    """Return the true views of the first camera of the recording of a simulated flight.

    Args:
        folder: Recording that `dronevio fly` or `dronevio run --keep-recording` has written.
        t_ns: (K,) Recorded time stamps of the frames, such as the keyframes of an estimator [ns].

    Raises:
        InputError: The folder holds no simulated flight with ground truth, or a time stamp is none of its frames.
    """
    world, seed = world_of(folder)
    recording = open_recording(folder, 1, repair=True)
    if recording.ground_truth is None:
        raise InputError(folder, "no ground truth", "a simulated flight")
    frames = read_frame_truth(folder / "mav0" / FRAME_TRUTH_FILE)
    rows = np.searchsorted(frames.t_ns, t_ns).clip(max=len(frames.t_ns) - 1)
    unknown = frames.t_ns[rows] != t_ns
    if unknown.any():
        raise InputError(folder, f"no frame at {t_ns[unknown][0]} ns", "time stamps of frames of the recording")
    return true_views(world, seed, recording.ground_truth, recording.rig.cameras[0], frames.exposed_ns[rows])


def recording_revisits(folder: Path, keyframe_times_ns: Times) -> FlightRevisits:
    """Return the revisits of the recording of a simulated flight, and the true views of the keyframes of an estimator.

    The first revisit is that of frames `INTERVAL_S` apart, so that it does not depend on the estimator.

    Args:
        folder: The recording.
        keyframe_times_ns: (K,) Times of the keyframes; none without a map [ns].

    Raises:
        InputError: The folder holds no simulated flight with ground truth.
    """
    frames_ns = read_frame_truth(folder / "mav0" / FRAME_TRUTH_FILE).t_ns
    step = max(1, round(INTERVAL_S * 1e9 / float(np.median(np.diff(frames_ns)))))
    keyframes_ns = frames_ns[nearest_rows(frames_ns, keyframe_times_ns)]
    t_ns = np.union1d(frames_ns[::step], keyframes_ns)
    views = recording_views(folder, t_ns)
    sampled, keyframes = (views[np.searchsorted(t_ns, chosen)] for chosen in (frames_ns[::step], keyframes_ns))
    revisits = find_revisits(sampled)
    first_ns = int(sampled.t_ns[revisits.now[0]]) if len(revisits.now) else None
    return FlightRevisits(first_ns, keyframes, find_revisits(keyframes).revisiting)


def true_views(world: str, seed: int, truth: Trajectory, camera: RigCamera, exposed_ns: npt.NDArray[np.int64]) -> Views:
    """Return the true views of a camera in a world.

    Args:
        world: Name of the world.
        seed: Seed of the world.
        truth: True trajectory of the IMU.
        camera: The camera with its mounting.
        exposed_ns: (K,) True times of the frames on the clock of the IMU [ns].

    Raises:
        ConfigError: The world is unknown.
    """
    poses = interpolated_poses(truth, exposed_ns) @ camera.T_imu_cam
    pixels = grid_pixels(camera.model)
    ranges = RayCaster(world, seed).ranges_m(poses, camera.model.unproject(pixels).reshape(-1, 3))
    path_m = np.interp(exposed_ns, truth.t_ns, path_lengths_m(truth.p_world_imu))
    return Views(exposed_ns, path_m, poses, camera.model, ranges.reshape(len(poses), *pixels.shape[:2]))
