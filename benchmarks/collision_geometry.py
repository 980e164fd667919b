"""Whether what collides is what is seen: random rays from free space against collision and visible geometry.

For each world and seed, rays start at random points that are at least 0.2 m from the keep-out boxes of path planning. A
ray is *invisible* if it crosses more than 10 cm of solid before the first visible surface, and *unsolid* if it passes a
visible surface within the bounds of the flight space by more than 10 cm without meeting a solid. Two exceptions are
meant, and not counted: fronds of ferns are visible, but not solid, since a drone pushes them aside, and panes of glass
are solid, but not visible.

    .venv/bin/python benchmarks/collision_geometry.py [WORLD …] [--seeds 3]
"""

import argparse
from collections import Counter

import mujoco
import numpy as np
import numpy.typing as npt
from measuring import print_rows

from dronevio.models.arrays import Array
from dronevio.sim.world import WORLDS, collision_spec, flight_area, instance_spec, solid_space

_COLLISION_GROUP, _VISIBLE_GROUP = 3, 0
_TOLERANCE_M, _STEP_M = 0.1, 0.02
_FARTHEST_M = 60.0


def first_hits(model: mujoco.MjModel, origins: Array, rays: Array, group: int) -> tuple[Array, npt.NDArray[np.int32]]:
    """Return distances [m] and geoms (K, S) that rays (S, 3) from points (K, 3) meet first; inf and −1 for none."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    groups = np.zeros(mujoco.mjNGROUP, np.uint8)
    groups[group] = 1
    ranges, geoms = np.empty((len(origins), len(rays))), np.empty((len(origins), len(rays)), np.int32)
    for row, origin in enumerate(origins):
        mujoco.mj_multiRay(
            model, data, origin, rays.ravel(), groups, True, -1, geoms[row], ranges[row], None, len(rays), _FARTHEST_M
        )
    return np.where(geoms >= 0, ranges, np.inf), geoms


def measured(world: str, seed: int, points: int = 100, rays: int = 48) -> tuple[float, float, list[str], list[str]]:
    """Return the percentages of invisible and of unsolid rays, and the names of what they meet, most frequent first."""
    rng, area, solids = np.random.default_rng(seed), flight_area(world, seed), solid_space(world, seed)
    low, high = area.space.low, area.space.high
    origins = rng.uniform(low, high, (40 * points, 3))
    origins = origins[area.space.clearance(origins) > 0.2][:points]
    along = rng.standard_normal((rays, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    colliding, seen = collision_spec(world, seed).compile(), instance_spec(world, seed).compile()
    solid_m, solid = first_hits(colliding, origins, along, _COLLISION_GROUP)
    seen_m, instance = first_hits(seen, origins, along, _VISIBLE_GROUP)
    bound_m = np.where(along > 0.0, (high - origins[:, None]) / along, (low - origins[:, None]) / along).min(axis=2)
    until_m = np.minimum(seen_m, bound_m)
    invisible = solid_m + _TOLERANCE_M < until_m
    for k, s in np.argwhere(invisible):
        steps = np.arange(solid_m[k, s], until_m[k, s], _STEP_M) + 0.5 * _STEP_M
        inside = solids.clearance(origins[k] + steps[:, None] * along[s]) < 0.0
        invisible[k, s] = inside.sum() * _STEP_M > _TOLERANCE_M
    unsolid = seen_m + _TOLERANCE_M < np.minimum(solid_m, bound_m)
    names = np.array([seen.geom(k).name for k in range(seen.ngeom)] + [""])
    unsolid &= ~np.char.startswith(names[instance], "fern")
    blocking = np.array([colliding.geom(k).name for k in range(colliding.ngeom)])
    invisible &= ~np.char.startswith(blocking[solid], "glass_part")
    blocks = [str(name).rsplit("_part", 1)[0] for name in blocking[solid[invisible]]]
    passed = [str(name) for name in names[instance][unsolid]]
    through, into = ([name for name, _ in Counter(found).most_common(3)] for found in (blocks, passed))
    return 100.0 * float(invisible.mean()), 100.0 * float(unsolid.mean()), through, into


def main() -> None:
    """Print a row for each world and seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", default=list(WORLDS), metavar="WORLD")
    parser.add_argument("--seeds", type=int, default=3)
    chosen = parser.parse_args()
    rows = []
    for world in chosen.worlds:
        for seed in range(chosen.seeds):
            invisible, unsolid, blocks, passed = measured(world, seed)
            cells = {"world": world, "seed": str(seed), "invisible (%)": f"{invisible:.2f}"}
            worst = ", ".join(dict.fromkeys(blocks + passed)) or "–"
            rows.append({**cells, "unsolid (%)": f"{unsolid:.2f}", "worst": worst})
    print_rows("What collides is what is seen", rows, ("worst",))


if __name__ == "__main__":
    main()
