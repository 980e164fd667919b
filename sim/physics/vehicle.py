"""MuJoCo models of the vehicle, for rendering and for the physics."""

from math import ceil

import mujoco
import numpy as np

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.imu import GRAVITY_M_S2
from dronevio.models.quadrotor import ROTOR_NAMES, Quadrotor
from dronevio.models.rig import Rig
from dronevio.models.rotation import quat_wxyz_from_matrix
from dronevio.sim.physics.collisions import COLLISION_GROUP, add_floor, add_movers, add_static_geoms
from dronevio.sim.physics.generated_body import generated_spec
from dronevio.sim.physics.own_body import own_spec

LONGEST_STEP_S = 1e-3
"""Longest time step of the physics [s]; the step divides the IMU interval."""
LOWEST_IMU_RATE_HZ = 100.0
"""Lowest supported IMU rate [Hz], since rotor forces are constant between IMU samples."""
_SETTLING_S = 1.0  # until the springs of the feet are at rest


def imu_interval_ns(rig: Rig) -> int:
    """Return the time between two IMU samples [ns].

    Raises:
        ConfigError: The IMU rate is too low for the physics.
    """
    if rig.imu.rate_hz < LOWEST_IMU_RATE_HZ:
        raise ConfigError(f"IMU rate of {rig.imu.rate_hz:g} Hz; expected at least {LOWEST_IMU_RATE_HZ:g} Hz")
    return round(1e9 / rig.imu.rate_hz)


def physics_steps(interval_s: float) -> int:
    """Return the number of MuJoCo's time steps in an IMU interval [s]: two or more, of at most `LONGEST_STEP_S`."""
    return max(2, ceil(interval_s / LONGEST_STEP_S - 1e-9))


def quadrotor_spec(quadrotor: Quadrotor, rig: Rig) -> mujoco.MjSpec:
    """Return the specification of the vehicle with its parameters and the sites of the rotors and the IMU.

    Raises:
        ConfigError: The packaged file of the body shows other rotors.
        InputError: The MJCF file of the vehicle is missing, damaged or not permitted.
    """
    if quadrotor.mjcf_file is None and quadrotor.mjcf is not None:
        spec = _packaged_spec(quadrotor)
    else:
        spec = generated_spec(quadrotor) if quadrotor.mjcf_file is None else own_spec(quadrotor.mjcf_file)
        _complete(spec, quadrotor)
    body = spec.body("quadrotor")
    body.mass = quadrotor.mass_kg
    body.inertia = quadrotor.inertia_kg_m2
    T = rig.T_vehicle_imu
    body.add_site(name="imu", pos=T[:3, 3], quat=quat_wxyz_from_matrix(T[:3, :3]), size=[0.005] * 3, group=4)
    return spec


def _packaged_spec(quadrotor: Quadrotor) -> mujoco.MjSpec:
    """Return the specification of a file of the package, with the sites of four rotors in place.

    Raises:
        ConfigError: The vehicle has another number of rotors.
    """
    if quadrotor.rotor_count != len(ROTOR_NAMES):
        raise ConfigError(
            f"mjcf_name = {quadrotor.mjcf_name!r}, a quadrotor, for {quadrotor.rotor_count} rotors; expected None, for"
            " a generated body"
        )
    spec = mujoco.MjSpec.from_file(str(quadrotor.mjcf))
    for name, position in zip(ROTOR_NAMES, quadrotor.rotor_positions_m, strict=True):
        spec.site(name).pos = position
    return spec


def _complete(spec: mujoco.MjSpec, quadrotor: Quadrotor) -> None:
    """Add to a body what the packaged files have: joint, centre of mass, sites, and the wrench as controls."""
    body = spec.body("quadrotor")
    body.add_freejoint(name="quadrotor")
    body.explicitinertial = True
    body.ipos, body.iquat = [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]
    size = [0.02 * quadrotor.reach_m] * 3
    body.add_site(name="vehicle", size=size, group=4)
    for k, position in enumerate(quadrotor.rotor_positions_m):
        body.add_site(name=f"rotor_{k}", pos=position, size=size, group=4)
    for k, name in enumerate(f"{kind}_{axis}" for kind in ("force", "torque") for axis in "xyz"):
        actuator = spec.add_actuator(name=name, trntype=mujoco.mjtTrn.mjTRN_SITE, target="vehicle")
        actuator.gear = np.eye(6)[k]


def physics_model(
    quadrotor: Quadrotor, rig: Rig, step_s: float, surroundings: mujoco.MjSpec | None = None
) -> mujoco.MjModel:
    """Return the vehicle with the static collision geoms of a world, without what is visible; with a floor by default.

    The six controls are the wrench at the centre of mass in the vehicle frame (see `Rotors`).
    """
    return physics_spec(quadrotor, rig, step_s, surroundings).compile()


def physics_spec(
    quadrotor: Quadrotor,
    rig: Rig,
    step_s: float,
    surroundings: mujoco.MjSpec | None = None,
    planes_only: bool = False,
) -> mujoco.MjSpec:
    """Return the specification of `physics_model`, with the planes of a world alone if they are wanted."""
    spec = _solid_quadrotor(quadrotor, rig)
    if surroundings is None:
        add_floor(spec)
    else:
        add_static_geoms(spec, surroundings, planes_only)
    if surroundings is not None and not planes_only:
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP  # spares the kinematics of all static geoms
        spec.body("quadrotor").sleep = mujoco.mjtSleepPolicy.mjSLEEP_NEVER
    spec.option.timestep = step_s
    spec.option.gravity = [0.0, 0.0, -GRAVITY_M_S2]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER  # permits exact IMU samples; see `Motion`
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC  # no creep of the feet
    return spec


def meeting_spec(quadrotor: Quadrotor, rig: Rig, surroundings: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return the specification of the vehicle and the moving objects of a world alone, for contacts between them."""
    spec = _solid_quadrotor(quadrotor, rig)
    add_movers(spec, surroundings)
    return spec


def _solid_quadrotor(quadrotor: Quadrotor, rig: Rig) -> mujoco.MjSpec:
    """Return the specification of the vehicle without visible geometry."""
    spec = quadrotor_spec(quadrotor, rig)
    for geom in [geom for geom in spec.geoms if geom.group != COLLISION_GROUP]:
        spec.delete(geom)
    return spec


def standing_pose(quadrotor: Quadrotor, rig: Rig, step_s: float) -> Array:
    """Return the pose (7,) of a drone at rest at the origin, with its weight on the springs of the feet."""
    model = physics_model(quadrotor, rig, step_s)
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, round(_SETTLING_S / step_s))
    return np.array(data.qpos)
