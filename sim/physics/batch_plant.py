"""Batch plant: the physics of many quadrotors of one type in one world, stepped together by `mujoco.batch`."""

from collections.abc import Sequence
from dataclasses import dataclass

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
    motion_of,
    rotated_back,
    rotations,
    specific_forces,
    velocities_of,
)
from dronevio.sim.physics.batch_simulation import BatchSimulation, Interval
from dronevio.sim.physics.batch_state import PlantState, PointSamples, SavedPlant
from dronevio.sim.physics.collisions import Moving
from dronevio.sim.physics.free_flight import FASTEST
from dronevio.sim.physics.motion import extrapolated_back
from dronevio.sim.physics.mover_contacts import BatchMoverContacts
from dronevio.sim.physics.rotors import Airflow, Rotors
from dronevio.sim.physics.vehicle import imu_interval_ns, meeting_spec, physics_spec, physics_steps, standing_pose
from dronevio.sim.physics.vehicle_states import Rows, VehicleParameters, VehicleStates, with_rows
from dronevio.sim.physics.wind import CALM, BatchAir, Winds

_ALL = slice(None)


@dataclass(frozen=True, eq=False)
class PlantWorld:
    """A world as a batch plant has it; only a floor by default."""

    spec: mujoco.MjSpec | None = None
    """Specification of the world, whose geoms of group 3 are solid; None is a floor at height 0."""
    movers: Sequence[Moving] = ()
    """All moving objects of the world; a vehicle that meets one has collided, but is not pushed."""
    ground_m: float = 0.0
    """Height of the ground of the ground effect [m]."""


class BatchPlant:
    """n quadrotors with rotor speed commands and noise-free IMUs, each in one of several worlds.

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
        worlds: Sequence[PlantWorld] = (PlantWorld(),),
        imu: bool = True,
        rng: np.random.Generator | None = None,
        nthread: int = 0,
    ) -> None:
        """Compile the physics model, and place all vehicles at rest at the origin.

        Args:
            count: Number of vehicles.
            rig: Mounting and rate of the IMU.
            quadrotor: The vehicle type; the research quadrotor of 1.5 kg by default.
            worlds: The worlds; all vehicles begin in the first one.
            imu: Whether IMU samples are computed.
            rng: Generator of the gusts; a fixed seed by default.
            nthread: Number of threads; 0 means one for each processor.

        Raises:
            ConfigError: There is no vehicle, or the IMU rate is too low.
        """
        if count < 1:
            raise ConfigError(f"{count} vehicles; expected 1 or more")
        self.rig = rig
        self.quadrotor = quadrotor or RESEARCH
        self.interval_ns = imu_interval_ns(rig)
        substeps = physics_steps(self.interval_s)
        step_s = self.interval_s / substeps
        self._ground_m = np.array([world.ground_m for world in worlds])
        planes, solids = (
            [physics_spec(self.quadrotor, rig, step_s, world.spec, planes_only) for world in worlds]
            for planes_only in (True, False)
        )
        self._simulation = BatchSimulation(planes, solids, count, substeps, nthread)
        self._imu = imu
        self._movers = {
            number: BatchMoverContacts(
                meeting_spec(self.quadrotor, rig, world.spec), world.movers, self.interval_s, count, nthread
            )
            for number, world in enumerate(worlds)
            if world.spec is not None and world.movers
        }
        self.standing_height_m = float(standing_pose(self.quadrotor, rig, step_s)[2])
        """Height of the centre of mass above the floor when a drone of the type stands on its feet [m]."""
        self._air = BatchAir(Winds.of(CALM, count), rng or np.random.default_rng(0))
        parameters, nothing = VehicleParameters.of(self.quadrotor, count), np.zeros(count, dtype=bool)
        self._rotors = Rotors(self.quadrotor, parameters)
        self.now = PlantState(
            parameters=parameters,
            rotors=self._rotors.steady_state(np.zeros((count, self.quadrotor.rotor_count))),
            elapsed=np.zeros(count, dtype=np.int64),
            world=np.zeros(count, dtype=np.intp),
            touched=nothing,
            diverged=nothing,
            motion=np.zeros((13, count)),
            ahead=np.zeros((13, count)),
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
        return VehicleStates(
            np.ascontiguousarray(motion[POSITION].T),
            np.ascontiguousarray(rotations(motion[QUATERNION]).transpose(2, 0, 1)),
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
        return SavedPlant(self._air.save(), self.now)

    def restore(self, saved: SavedPlant) -> None:
        """Return to a state of a plant of the same vehicle type, world and rates, with as many vehicles."""
        self.now = saved.vehicles
        self._rotors = Rotors(self.quadrotor, self.now.parameters)
        self._air.restore(saved.air)

    def reset(
        self,
        mask: Mask,
        states: VehicleStates,
        parameters: VehicleParameters | None = None,
        winds: Winds | None = None,
        world: npt.NDArray[np.intp] | None = None,
    ) -> None:
        """Reset clock, gusts and states of the vehicles in a mask; other vehicles are not changed.

        Args:
            mask: (n,) The vehicles to reset.
            states: States of n vehicles, of which only the rows of the mask are used.
            parameters: New parameters of n vehicles, of which only the rows of the mask are used; unchanged by default.
            winds: New winds at n vehicles, of which only the rows of the mask are used; unchanged by default.
            world: (n,) Indices of new worlds, of which only the rows of the mask are used; unchanged by default.

        Raises:
            ConfigError: A state is not finite, or faster than `FASTEST`.
        """
        rows = np.flatnonzero(mask)
        if rows.size == 0:
            return
        states = states.rows(rows)
        states.check(FASTEST)
        own = (parameters or self.now.parameters).rows(rows)
        self._air.renew(rows, self.winds if winds is None else with_rows(self.winds, rows, winds.rows(rows)))
        model, nothing = Rotors(self.quadrotor, own), np.zeros(rows.size, dtype=bool)
        rotors = model.steady_state(states.rotor_speed_rad_s, states.battery_charge)
        motion, place = motion_of(states), (self.now.world if world is None else world)[rows]
        wrench = model.wrench(rotors, self._airflow(motion, rows, place))
        elapsed = np.zeros(rows.size, dtype=np.int64)
        flown = self._run(rows, motion, wrench, own, place, nothing, nothing, elapsed)
        between, samples = np.zeros((3, rows.size)), self.now.samples.rows(rows)
        if self._imu:
            before = extrapolated_back(flown.start, flown.middle)  # to before t = 0
            between = velocities_of(self.rig.T_vehicle_imu[:3, 3], before)
            between, samples = self._sample(flown.start, between, flown.middle)
        placed = PlantState(
            own, rotors, elapsed, place, flown.touched, flown.diverged, flown.start, flown.end, between, samples
        )
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
        wrench = self._rotors.wrench(rotors, self._airflow(now.ahead, _ALL, now.world))
        flown = self._run(_ALL, now.ahead, wrench, now.parameters, now.world, now.touched, diverged, now.elapsed + 1)
        between, samples = now.velocity_between, now.samples
        if self._imu:
            between, samples = self._sample(flown.start, between, flown.middle)
        self.now = PlantState(
            now.parameters,
            rotors,
            now.elapsed + 1,
            now.world,
            flown.touched,
            flown.diverged,
            flown.start,
            flown.end,
            between,
            samples,
        )
        return samples

    def _run(
        self,
        rows: Rows,
        motion: Array,
        wrench: Array,
        vehicles: VehicleParameters,
        world: npt.NDArray[np.intp],
        touched: Mask,
        diverged: Mask,
        number: npt.NDArray[np.int64],
    ) -> Interval:
        """Run k simulations for an interval, which a number (k,) of others precedes, and find the contacts at its end.

        The other arguments are those of `BatchSimulation.run`.
        """
        flown = self._simulation.run(motion, wrench, vehicles, world, touched, diverged)
        for index, movers in self._movers.items():
            some = np.flatnonzero(world == index)
            if some.size:
                flown.touched[some] |= movers.detect(
                    np.arange(self.count)[rows][some], number[some] + 1, flown.end[:7, some].T
                )
        return flown

    def _airflow(self, motion: Array, rows: Rows, world: npt.NDArray[np.intp]) -> Airflow:
        """Return the airflow at k vehicles in their worlds (k,), and advance the gusts by the way of an interval."""
        R = rotations(motion[QUATERNION])
        through_air = motion[VELOCITY] - self._air.velocity_m_s(rows).T
        self._air.move_through(np.sqrt((through_air * through_air).sum(axis=0)) * self.interval_s, rows)
        return Airflow(rotated_back(R, through_air).T, motion[RATE].T, R[2].T, motion[2] - self._ground_m[world])

    def _sample(self, motion: Array, before: Array, middle: Array) -> tuple[Array, PointSamples]:
        """Return the samples of k IMUs, after their velocities (3, k) half an interval later.

        Args:
            motion: (13, k) Motion at the clock.
            before: (3, k) Velocities of the IMUs half an interval earlier [m/s].
            middle: (13, k) Motion half an interval later.
        """
        T = self.rig.T_vehicle_imu
        after = velocities_of(T[:3, 3], middle)
        force = specific_forces(rotations(motion[QUATERNION]), before, after, self.interval_s)  # in the vehicle frame
        return after, PointSamples(motion[RATE].T @ T[:3, :3], force.T @ T[:3, :3])
