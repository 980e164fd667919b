"""Processor time of the physics in each world, of one vehicle and of many, alone or beside another checkout.

Vehicles fly for 0.3 s from random places that are at least 0.46 m from what planned paths avoid, at up to 1.5 m/s; or
they stand on the landing pad. With ``--beside``, the other checkout is measured in turn with this one, so that other
programs disturb both alike; the ratio is the median of those of pairs of runs, and above 1 if this checkout is faster.

    .venv/bin/python benchmarks/world_physics.py [WORLD …] [--beside CHECKOUT] [--runs 15]
"""

import argparse
import inspect
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

_WORLDS = ("room", "corridor", "warehouse", "hall", "forest", "gates", "moving")
_INTERVALS, _CLEARANCE_M, _SPEED_M_S = 60, 0.46, 1.5
_SINGLE, _STANDING, _COUNTS = "one", "128 standing", (128, 1024)
_PLACES_OF_ONE = 8


def worker() -> None:
    """Answer lines of standard input, a world and what to simulate, with the time of an IMU interval [µs]."""
    ready: dict[str, tuple[Callable[[], None], int]] = {}
    for line in sys.stdin:
        if line not in ready:
            world, kind = line.strip().split(maxsplit=1)
            ready = {line: _one(world) if kind == _SINGLE else _many(world, int(kind.split()[0]), "standing" in kind)}
            ready[line][0]()
        run, intervals = ready[line]
        start_s = time.process_time()
        run()
        print(1e6 * (time.process_time() - start_s) / intervals, flush=True)


def _surroundings(plant: type, world: str) -> dict[str, Any]:
    """Return the arguments of a plant that describe a world."""
    from dronevio.sim.world import collision_spec, illumination_and_movers

    parameters, spec = inspect.signature(plant).parameters, collision_spec(world, 1)
    movers: Any = ()
    if {"movers", "worlds"} & set(parameters):
        movers = illumination_and_movers(world, 1)[1]
    if "worlds" in parameters:
        from dronevio.sim.physics.batch_plant import PlantWorld

        return {"worlds": [PlantWorld(spec, movers)]}
    return {"surroundings": spec, **({"movers": movers} if "movers" in parameters else {})}


def _starts(world: str, count: int) -> tuple[Any, Any]:
    """Return places (N, 3) and velocities (N, 3)."""
    from dronevio.sim.world import flight_area

    space, rng = flight_area(world, 1).space, np.random.default_rng(0)
    places = rng.uniform(space.low, space.high, (60 * count, 3))
    places = places[space.clearance(places) > _CLEARANCE_M]
    return places[np.arange(count) % len(places)], rng.uniform(-1.0, 1.0, (count, 3)) * _SPEED_M_S * [1.0, 1.0, 0.2]


def _one(world: str) -> tuple[Callable[[], None], int]:
    """Return a function that flies one vehicle, and its number of intervals."""
    from dronevio.models.rig import euroc_rig
    from dronevio.models.rotation import pose_matrix
    from dronevio.sim.physics.plant import QuadrotorPlant

    plant = QuadrotorPlant(euroc_rig(), **_surroundings(QuadrotorPlant, world))
    speeds, starts = np.full(4, plant.quadrotor.hover_speed_rad_s), _starts(world, _PLACES_OF_ONE)

    def run() -> None:
        for place, velocity in zip(*starts, strict=True):
            plant.reset(pose_matrix(np.eye(3), place), velocity, rotor_speeds_rad_s=speeds)
            plant.advance(_INTERVALS * plant.interval_ns, speeds)

    return run, _PLACES_OF_ONE * _INTERVALS


def _many(world: str, count: int, standing: bool) -> tuple[Callable[[], None], int]:
    """Return a function that flies many vehicles, and its number of intervals, summed over vehicles."""
    from dronevio.models.rig import euroc_rig
    from dronevio.sim.physics.batch_plant import BatchPlant
    from dronevio.sim.physics.vehicle_states import VehicleStates
    from dronevio.sim.world import flight_area

    plant = BatchPlant(count, euroc_rig(), nthread=1, **_surroundings(BatchPlant, world))
    if standing:
        places = np.tile(flight_area(world, 1).pad + [0.0, 0.0, plant.standing_height_m], (count, 1))
        states, speed = VehicleStates.at(places), 0.0
    else:
        places, velocity = _starts(world, count)
        speed = plant.quadrotor.hover_speed_rad_s
        states = VehicleStates.at(places, None, velocity, rotor_speed_rad_s=speed)
    speeds = np.full((count, 4), speed)
    intervals = _INTERVALS if count <= min(_COUNTS) else _INTERVALS // 3

    def run() -> None:
        plant.reset(np.ones(count, dtype=bool), states)
        for _ in range(intervals):
            plant.advance(speeds)

    return run, count * intervals


def started(checkout: Path) -> subprocess.Popen[str]:
    """Return a worker that simulates with the code of a checkout."""
    environment = {**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    command = [sys.executable, str(Path(__file__).resolve()), "--worker"]
    pipe = subprocess.PIPE
    return subprocess.Popen(command, cwd=checkout, env=environment, stdin=pipe, stdout=pipe, text=True)


def spent_us(process: subprocess.Popen[str], line: str) -> float:
    """Return the time of an interval that a worker measures [µs]."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(f"{line}\n")
    process.stdin.flush()
    return float(process.stdout.readline())


def main() -> None:
    """Print a row for each world."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", default=list(_WORLDS), metavar="WORLD")
    parser.add_argument("--beside", type=Path)
    parser.add_argument("--runs", type=int, default=15)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    chosen = parser.parse_args()
    if chosen.worker:
        worker()
        return
    from measuring import print_rows

    checkouts = [Path(__file__).resolve().parents[1], *([chosen.beside.resolve()] if chosen.beside else [])]
    workers = [started(checkout) for checkout in checkouts]
    rows = []
    for world in chosen.worlds:
        cells = {"world": world}
        for kind in (_SINGLE, *map(str, _COUNTS), _STANDING):
            times = np.array(
                [[spent_us(process, f"{world} {kind}") for process in workers] for _ in range(chosen.runs)]
            )
            cells[f"{kind} (µs)"] = f"{np.median(times[:, 0]):.1f}"
            if chosen.beside:
                cells[f"{kind}, ratio"] = f"{np.median(times[:, 1] / times[:, 0]):.2f}"
        rows.append(cells)
    for process in workers:
        process.terminate()
    print_rows("Processor time of an IMU interval of a vehicle", rows)


if __name__ == "__main__":
    main()
