"""Batch plant: the physics of many quadrotors of one type in one world, stepped together by `mujoco.batch`."""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import numpy.typing as npt

from dronevio.models.arrays import Array, Mask
from dronevio.models.errors import ConfigError
from dronevio.models.quadrotor import RESEARCH, Quadrotor
from dronevio.models.rig import Rig
from dronevio.sim.physics.batch_motion import (
    POSITION,
    QUATERNION,
    RATE,
    VELOCITY,
    rotated_back,
    rotations,
    rotations_at_velocities,
    specific_forces,
    velocities_of,
)
from dronevio.sim.physics.batch_simulation import FASTEST, BatchSimulation, Interval
from dronevio.sim.physics.batch_state import PlantState, PointSamples, SavedPlant
from dronevio.sim.physics.collisions import Moving
from dronevio.sim.physics.motion import extrapolated_back
from dronevio.sim.physics.mover_contacts import BatchMoverContacts
from dronevio.sim.physics.rotors import Airflow, Rotors
from dronevio.sim.physics.vehicle import LONGEST_STEP_S, imu_interval_ns, meeting_spec, physics_spec, standing_pose
from dronevio.sim.physics.vehicle_states import Rows, VehicleParameters, VehicleStates, with_rows
from dronevio.sim.physics.wind import CALM, BatchAir, Winds

_ALL = slice(None)


class BatchPlant:
    """n quadrotors with rotor speed commands and noise-free IMUs.

    Clock, wrench, latency and IMU samples are those of `QuadrotorPlant`: time advances in IMU intervals, the wrench of
    the rotors is constant over the steps of an interval, and the physics are one interval ahead of the clock. Results
    do not depend on the number of threads.

    A vehicle whose state or command is not finite, or that is faster than any quadrotor, is marked as diverged. It
    keeps its last finite pose, with zero velocities, until it is reset.
    """

    def __init__(
        self,
        count: int,
        rig: Rig,
        quadrotor: Quadrotor | None = None,
        *,
        step_s: float = LONGEST_STEP_S,
        surroundings: mujoco.MjSpec | None = None,
        movers: Sequence[Moving] = (),
        ground_m: float = 0.0,
        imu: bool = True,
        rng: np.random.Generator | None = None,
        nthread: int = 0,
    ) -> None:
        """Compile the physics model, and place all vehicles at rest at the origin.

        Args:
            count: Number of vehicles.
            rig: Mounting and rate of the IMU.
            quadrotor: The vehicle type; the research quadrotor of 1.5 kg by default.
            step_s: Time step of the physics [s]; at most half the IMU interval, of which it is a fraction.
            surroundings: Specification of a world, whose geoms of group 3 are solid; only a floor by default.
            movers: All moving objects of the world; a vehicle that meets one has collided, but is not pushed.
            ground_m: Height of the ground of the ground effect [m].
            imu: Whether IMU samples are computed.
            rng: Generator of the gusts; a fixed seed by default.
            nthread: Number of threads; 0 means one for each processor.

        Raises:
            ConfigError: There is no vehicle, the IMU rate is too low, or the time step does not divide the IMU
                interval into two or more steps.
        """
        if count < 1:
            raise ConfigError(f"{count} vehicles; expected 1 or more")
        self.rig = rig
        self.quadrotor = quadrotor or RESEARCH
        self.interval_ns = imu_interval_ns(rig)
        substeps = _substeps(self.interval_s, step_s)
        self._step_s = self.interval_s / substeps
        self._ground_m = ground_m
        spec = physics_spec(self.quadrotor, rig, self._step_s, surroundings)
        self._simulation = BatchSimulation(spec, count, substeps, imu, nthread)
        self._movers: BatchMoverContacts | None = None
        if surroundings is not None and movers:
            meeting = meeting_spec(self.quadrotor, rig, surroundings)
            self._movers = BatchMoverContacts(meeting, movers, self.interval_s, count, nthread)
        self.standing_height_m = float(standing_pose(self.quadrotor, rig, self._step_s)[2])
        """Height of the centre of mass above the floor when a drone of the type stands on its feet [m]."""
        self._air = BatchAir(Winds.of(CALM, count), rng or np.random.default_rng(0))
        parameters, nothing = VehicleParameters.of(self.quadrotor, count), np.zeros(count, dtype=bool)
        self._rotors = Rotors(self.quadrotor, parameters)
        self.now = PlantState(
            parameters=parameters,
            rotors=self._rotors.steady_state(np.zeros((count, self.quadrotor.rotor_count))),
            elapsed=np.zeros(count, dtype=np.int64),
            touched=nothing,
            diverged=nothing,
            motion=np.zeros((13, count)),
            velocity_between=np.zeros((3, count)),
            samples=PointSamples(np.zeros((count, 3)), np.zeros((count, 3))),
        )
        """State of the vehicles at the current time; in a plant without IMUs, their samples are zeros."""
        pads, rotor_count = np.tile([0.0, 0.0, self.standing_height_m], (count, 1)), self.quadrotor.rotor_count
        self.reset(~nothing, VehicleStates.at(pads, rotors=rotor_count))

    @property
    def count(self) -> int:
        """Number of vehicles."""
        return len(self.now.elapsed)

    @property
    def interval_s(self) -> float:
        """Length of an IMU interval [s]."""
        return self.interval_ns * 1e-9

    @property
    def t_ns(self) -> npt.NDArray[np.int64]:
        """(n,) Times since the last reset of each vehicle [ns]."""
        return self.now.elapsed * self.interval_ns

    @property
    def states(self) -> VehicleStates:
        """True states of the vehicles."""
        motion, rotors = self.now.motion, self.now.rotors
        position = motion[POSITION] - 0.5 * self._step_s * motion[VELOCITY]
        R = rotations_at_velocities(motion, self._step_s)
        return VehicleStates(
            np.ascontiguousarray(position.T),
            np.ascontiguousarray(R.transpose(2, 0, 1)),
            np.ascontiguousarray(motion[VELOCITY].T),
            np.ascontiguousarray(motion[RATE].T),
            rotors.speed_rad_s.copy(),
            rotors.charge.copy(),
            rotors.voltage_v.copy(),
        )

    @property
    def winds(self) -> Winds:
        """Mean winds and strengths of gusts at the vehicles."""
        return self._air.winds

    @property
    def wind_m_s(self) -> Array:
        """(n, 3) Current velocities of the air at the vehicles in the world frame [m/s]."""
        return self._air.velocity_m_s().copy()

    def reseed(self, rng: np.random.Generator) -> None:
        """Draw gusts from streams of another generator from now on."""
        self._air.reseed(rng)

    def save(self) -> SavedPlant:
        """Return the state of vehicles, gusts and clocks, with arrays that no later step changes."""
        return SavedPlant(self._simulation.save(), self._air.save(), self.now)

    def restore(self, saved: SavedPlant) -> None:
        """Return to a state of a plant of the same vehicle type, world and rates, with as many vehicles."""
        self.now = saved.vehicles
        self._rotors = Rotors(self.quadrotor, self.now.parameters)
        self._simulation.restore(saved.physics, self.now.parameters)
        self._air.restore(saved.air)

    def reset(
        self,
        mask: Mask,
        states: VehicleStates,
        parameters: VehicleParameters | None = None,
        winds: Winds | None = None,
    ) -> None:
        """Reset clock, gusts and states of the vehicles in a mask; other vehicles are not changed.

        Args:
            mask: (n,) The vehicles to reset.
            states: States of n vehicles, of which only the rows of the mask are used.
            parameters: New parameters of n vehicles, of which only the rows of the mask are used; unchanged by default.
            winds: New winds at n vehicles, of which only the rows of the mask are used; unchanged by default.

        Raises:
            ConfigError: A state is not finite, or faster than `FASTEST`.
        """
        rows = np.flatnonzero(mask)
        if rows.size == 0:
            return
        states = states.rows(rows)
        states.check(FASTEST)
        own = (parameters or self.now.parameters).rows(rows)
        if parameters is not None:
            self._simulation.change_bodies(rows, own)
        self._air.renew(rows, self.winds if winds is None else with_rows(self.winds, rows, winds.rows(rows)))
        self._simulation.place(rows, states)
        model, nothing = Rotors(self.quadrotor, own), np.zeros(rows.size, dtype=bool)
        rotors = model.steady_state(states.rotor_speed_rad_s, states.battery_charge)
        motion = self._simulation.motion(rows)
        wrench = model.wrench(rotors, self._airflow(motion, rows))
        elapsed = np.zeros(rows.size, dtype=np.int64)
        flown = self._run(rows, motion, wrench, nothing, nothing, elapsed)
        between, samples = np.zeros((3, rows.size)), self.now.samples.rows(rows)
        if flown.middle is not None:
            before = extrapolated_back(flown.start, flown.middle)  # to before t = 0
            between = velocities_of(self.rig.T_vehicle_imu[:3, 3], before, self._step_s)
            between, samples = self._sample(flown.start, between, flown.middle)
        placed = PlantState(own, rotors, elapsed, flown.touched, flown.diverged, flown.start, between, samples)
        self.now = self.now.with_vehicles(rows, placed)
        if parameters is not None:
            self._rotors = Rotors(self.quadrotor, self.now.parameters)

    def advance(self, commands: Array) -> PointSamples:
        """Apply commands (n, R) of rotor speeds [rad/s] for one IMU interval, and return the IMU samples at its end."""
        now = self.now
        diverged, finite = now.diverged, np.isfinite(commands)
        if not finite.all():
            rows = np.asarray(finite.all(axis=1))
            diverged, commands = diverged | ~rows, np.where(rows[:, None], commands, 0.0)
        rotors = self._rotors.step(now.rotors, commands, self.interval_s)
        motion = self._simulation.motion(_ALL)
        wrench = self._rotors.wrench(rotors, self._airflow(motion, _ALL))
        flown = self._run(_ALL, motion, wrench, now.touched, diverged, now.elapsed + 1)
        between, samples = now.velocity_between, now.samples
        if flown.middle is not None:
            between, samples = self._sample(flown.start, between, flown.middle)
        self.now = PlantState(
            now.parameters, rotors, now.elapsed + 1, flown.touched, flown.diverged, flown.start, between, samples
        )
        return samples

    def _run(
        self, rows: Rows, motion: Array, wrench: Array, touched: Mask, diverged: Mask, number: npt.NDArray[np.int64]
    ) -> Interval:
        """Run k simulations for an interval, which a number (k,) of others precedes, and find the contacts at its end.

        The other arguments are those of `BatchSimulation.run`.
        """
        flown = self._simulation.run(rows, motion, wrench, touched, diverged)
        if self._movers is None:
            return flown
        indices, pose = np.arange(self.count)[rows], self._simulation.motion(rows)[:7].T
        return replace(flown, touched=flown.touched | self._movers.detect(indices, number + 1, pose))

    def _airflow(self, motion: Array, rows: Rows) -> Airflow:
        """Return the airflow at k vehicles, and advance the gusts by the distance of an interval."""
        R = rotations(motion[QUATERNION])
        through_air = motion[VELOCITY] - self._air.velocity_m_s(rows).T
        self._air.move_through(np.sqrt((through_air * through_air).sum(axis=0)) * self.interval_s, rows)
        return Airflow(rotated_back(R, through_air).T, motion[RATE].T, R[2].T, motion[2] - self._ground_m)

    def _sample(self, motion: Array, before: Array, middle: Array) -> tuple[Array, PointSamples]:
        """Return the samples of k IMUs, after their velocities (3, k) half an interval later.

        Args:
            motion: (13, k) Motion at the clock.
            before: (3, k) Velocities of the IMUs half an interval earlier [m/s].
            middle: (13, k) Motion half an interval later.
        """
        T = self.rig.T_vehicle_imu
        after = velocities_of(T[:3, 3], middle, self._step_s)
        R = rotations_at_velocities(motion, self._step_s)
        force = specific_forces(R, before, after, self.interval_s)  # in the vehicle frame
        return after, PointSamples(motion[RATE].T @ T[:3, :3], force.T @ T[:3, :3])


def _substeps(interval_s: float, step_s: float) -> int:
    """Return the number of time steps in an IMU interval.

    Raises:
        ConfigError: The time step does not divide the interval into two or more steps.
    """
    count = round(interval_s / step_s) if step_s > 0.0 else 0
    if count < 2 or abs(count * step_s - interval_s) > 1e-6 * interval_s:
        raise ConfigError(
            f"time step of {step_s:g} s; expected a half, third, … of the IMU interval of {interval_s:g} s"
        )
    return count
