"""The dense map of one flight with other rigs: lenses, baselines, arrangements, rates, sizes, shutters and clocks.

Ten seconds in a room are recorded with each rig, and mapped from its images at the poses of visual SLAM. The table has
the same errors as ``dense_map.py worlds``, and the error of the poses at which depth enters the map, median and 95 %,
by the true pose of the camera at its true exposure. ``hidden`` rigs have errors that their calibration does not tell::

    python benchmarks/map_rigs.py /tmp/map-rigs
    python benchmarks/map_rigs.py /tmp/map-rigs --only fisheye "30 ms late"
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from dense_map_runs import MapRun, in_world, slam_estimates
from dense_map_truth import seen_space
from measuring import Row, print_as_made, text

from dronevio.estimator.mapping import DenseMapConfig, DenseMapper
from dronevio.estimator.mapping.rectification import rectified_pair
from dronevio.eval.metrics.alignment import align
from dronevio.eval.metrics.association import interpolate
from dronevio.eval.metrics.occupancy import are_falsely_free, state_shares, surface_scores
from dronevio.models.arrays import Array
from dronevio.models.imu import Times
from dronevio.models.recordings.open import open_recording
from dronevio.models.rig import Rig, RigCamera
from dronevio.models.rig_presets import PINHOLE, TUM_VI_CAMERA, rig_named
from dronevio.models.rotation import exp_so3, log_so3, pose_matrix
from dronevio.models.state import Trajectory
from dronevio.recording.recorder import record_flight
from dronevio.sim.faults import Faults
from dronevio.sim.scenario import Scenario
from dronevio.sim.scenarios import scenario_named

DISTANCES_M = (0.05, 0.1, 0.2)


@dataclass(frozen=True)
class MapRigsCommand:
    """Where flights are recorded, and with which rigs."""

    folder: tyro.conf.Positional[Path]
    """Folder of the recordings; those that are complete are used again."""
    only: tuple[str, ...] = ()
    """Names of rigs; all by default."""
    seed: int = 1
    """Seed of the flight and its room."""


def rigs() -> dict[str, tuple[Rig, Faults]]:
    """Return the rigs with their hidden faults, by name."""
    euroc, level = rig_named("euroc-stereo"), rig_named("pinhole-stereo")
    left, right = level.cameras
    fisheye = each(level, model=TUM_VI_CAMERA)
    below = pose_matrix(left.T_imu_cam[:3, :3], left.T_imu_cam[:3, 3] - [0.0, 0.0, 0.11])
    behind = pose_matrix(left.T_imu_cam[:3, :3] @ exp_so3(np.array([0.0, np.pi, 0.0])), np.array([-0.1, 0.0, 0.0]))
    apart = pose_matrix(left.T_imu_cam[:3, :3], left.T_imu_cam[:3, 3] - [0.0, 0.30, 0.0])
    late = replace(euroc.cameras[1], time_offset_s=0.004)
    true = {
        "euroc": euroc,
        "pinhole": level,
        "fisheye 133°": rig_named("fisheye-stereo"),
        "fisheye 154°": fisheye,
        "30 cm apart": replace(level, cameras=(left, replace(right, T_imu_cam=apart))),
        "one above the other": replace(level, cameras=(left, replace(right, T_imu_cam=below))),
        "third one behind": replace(level, cameras=(RigCamera(PINHOLE.resized(376, 240), behind), left, right)),
        "320 × 204": each(euroc, size=(320, 204)),
        "1280 × 816": each(level, size=(1280, 816)),
        "10 Hz": each(euroc, rate_hz=10.0),
        "60 Hz": each(euroc, rate_hz=60.0),
        "rolling, 30 ms": each(euroc, readout_s=0.03),
        "30 ms late": replace(euroc, time_offset_s=0.03),
        "second 4 ms late": replace(euroc, cameras=(euroc.cameras[0], late)),
        "one fisheye": rig_named("fisheye"),
        "one, rolling": rig_named("rolling"),
    }
    hidden = {
        "hidden: 15 ms late": Faults(hidden_time_offset_s=0.015),
        "hidden: cameras turned": Faults(hidden_tilt_rad=0.02),
    }
    return {name: (rig, Faults()) for name, rig in true.items()} | {name: (euroc, f) for name, f in hidden.items()}


def each(rig: Rig, *, size: tuple[int, int] | None = None, **changes: object) -> Rig:
    """Return a rig all of whose cameras are changed, and whose images have another size (width, height) [px]."""
    cameras = (replace(camera, **changes) for camera in rig.cameras)  # type: ignore[arg-type]
    sized = (replace(c, model=c.model.resized(*size)) if size else c for c in cameras)
    return replace(rig, cameras=tuple(sized))


def flight_of(rig: Rig, faults: Faults, seed: int) -> Scenario:
    """Return a flight of ten seconds in a room."""
    scenario, w = scenario_named("room-easy", seed), scenario_named("room", seed).plan
    plan = replace(w, initial_rest_s=0.5, takeoff_s=1.5, tour_s=6.5, landing_s=1.5, final_rest_s=0.2)
    plan = replace(plan, waypoints=w.waypoints[:5])
    return replace(scenario, rig=rig, plan=plan, faults=faults)


def row_of(name: str, folder: Path, faults: Faults) -> Row:
    """Return the row of a recording."""
    recording, config = open_recording(folder, repair=True), DenseMapConfig()
    rig, truth = recording.rig, recording.ground_truth
    assert truth is not None
    pair, run, poses, density = rectified_pair(rig), MapRun(DenseMapper(rig, config)), [], []
    for frame, estimate in slam_estimates(recording):
        depth = run.mapper.add_frame(frame, estimate)
        if depth is not None:
            run.t_ns.append(frame.t_ns)
            run.estimates.append(estimate)
            poses.append(depth.T_odom_cam)
            density.append(float(depth.known.mean()))
    camera, grid = rig.cameras[pair.left if pair else 0], run.mapper.fused()
    row = {"rig": name, "depths": str(len(poses))}
    if grid is None or not poses:
        return row
    R, t = in_world(run, truth, grid)
    seen = seen_space(folder, truth, camera, recording.frame_times_ns[::2], config.range_m)
    surface = seen.surface[seen.surface_ns >= run.t_ns[0]] @ R.T + t
    scores = surface_scores(grid, seen.all_surface @ R.T + t, surface, DISTANCES_M)
    late_s = rig.time_offset_s + camera.time_offset_s + faults.hidden_time_offset_s
    exposed_ns = np.array(run.t_ns, dtype=np.int64) + round(1e9 * late_s)
    away_m, turn_rad = pose_errors(truth, exposed_ns, np.array(poses), camera.T_imu_cam)
    turns_rad = np.percentile(turn_rad, [50, 95])
    # Cameras that are exposed one after another are rectified to axes that turn with the motion
    is_turning = pair is not None and rig.cameras[pair.left].time_offset_s != rig.cameras[pair.right].time_offset_s
    return row | {
        "known": text(float(np.mean(density)), ".2f"),
        "samples": str(len(surface)),
        "false free": f"{100.0 * are_falsely_free(grid, surface).mean():.3f} %",
        "accuracy": " ".join(text(100.0 * score.accuracy, ".0f") for score in scores),
        "completeness": " ".join(text(100.0 * score.completeness, ".0f") for score in scores),
        "free known": f"{100.0 * state_shares(grid, seen.free @ R.T + t).free:.0f} %",
        "position [cm]": " ".join(text(100.0 * float(v), ".1f") for v in np.percentile(away_m, [50, 95])),
        "turn [°]": "–" if is_turning else " ".join(text(float(np.degrees(v)), ".2f") for v in turns_rad),
    }


def pose_errors(truth: Trajectory, t_ns: Times, Ts_odom_cam: Array, T_imu_cam: Array) -> tuple[Array, Array]:
    """Return errors of position (N,) [m] and orientation (N,) [rad] of the poses of depth images.

    The rectified camera is turned against the real one by a rotation that the poses have in common; it is left out.
    """
    true, rows = interpolate(truth, t_ns)
    found, wanted = Ts_odom_cam[rows], true.Ts_world_imu @ T_imu_cam
    to_truth = align(wanted[:, :3, 3], found[:, :3, 3])
    away_m = np.linalg.norm(to_truth.positions(found[:, :3, 3]) - wanted[:, :3, 3], axis=1)
    between = np.swapaxes(wanted[:, :3, :3], 1, 2) @ to_truth.R_truth_estimate @ found[:, :3, :3]
    u, _, vt = np.linalg.svd(between.sum(axis=0))
    return np.asarray(away_m), np.linalg.norm(log_so3(between @ (u @ vt).T), axis=1)


def rows(command: MapRigsCommand) -> Iterator[Row]:
    """Record what is missing, and yield the rows."""
    for name, (rig, faults) in rigs().items():
        if command.only and name not in command.only:
            continue
        folder = command.folder / f"{name}-{command.seed}".replace(" ", "-").replace(":", "")
        if not (folder / "scenario.json").exists() or (folder / "mav0" / "INCOMPLETE").exists():
            record_flight(flight_of(rig, faults, command.seed), folder)
        yield row_of(name, folder, faults)


if __name__ == "__main__":
    print_as_made(rows(tyro.cli(MapRigsCommand, description=__doc__)))
