"""Whether what collides is what is seen: random rays from free space against collision and visible geometry.

For each world and seed, rays start at random points that are at least 0.2 m from solids, within racks and trees too. A
ray is *invisible* if it crosses more than 10 cm of solid before the first visible surface, and *unsolid* if it passes a
visible surface within the bounds of the flight space by more than 10 cm without meeting a solid. A ray is *open* if the
first surface that it meets is one from behind, which is not drawn: a camera there sees into a solid. Exceptions are
meant, and not counted: fronds of ferns are visible, but not solid, since a drone pushes them aside, panes of glass are
solid, but not visible, and leaves are drawn from both sides.

    .venv/bin/python benchmarks/collision_geometry.py [WORLD …] [--seeds 3]
"""

import argparse
from collections import Counter
from dataclasses import dataclass

import mujoco
import numpy as np
import numpy.typing as npt
from measuring import print_rows

from dronevio.models.arrays import Array
from dronevio.sim.world import WORLDS, collision_spec, flight_area, instance_spec, solid_space

_COLLISION_GROUP, _VISIBLE_GROUP = 3, 0
_TOLERANCE_M, _STEP_M = 0.1, 0.02
_FARTHEST_M = 60.0
_LEAFY = ("tree", "fern", "bush")  # drawn from both sides


@dataclass(frozen=True, eq=False)
class Hits:
    """What rays (S, 3) from points (K, 3) meet first."""

    ranges_m: Array
    """(K, S) Distances; inf where nothing is met [m]."""
    geoms: npt.NDArray[np.int32]
    """(K, S) Geoms; −1 where nothing is met."""
    from_behind: npt.NDArray[np.bool_]
    """(K, S) Whether the surface is met from behind."""


def first_hits(model: mujoco.MjModel, origins: Array, rays: Array, group: int) -> Hits:
    """Return what rays (S, 3) from points (K, 3) meet first."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    groups = np.zeros(mujoco.mjNGROUP, np.uint8)
    groups[group] = 1
    shape = len(origins), len(rays)
    ranges, geoms, normals = np.empty(shape), np.empty(shape, np.int32), np.empty((*shape, 3))
    for row, origin in enumerate(origins):
        found = geoms[row], ranges[row], normals[row].reshape(-1)
        mujoco.mj_multiRay(model, data, origin, rays.ravel(), groups, True, -1, *found, len(rays), _FARTHEST_M)
    met = geoms >= 0
    return Hits(np.where(met, ranges, np.inf), geoms, met & (np.sum(normals * rays, axis=2) > 1e-6))


def measured(world: str, seed: int, points: int = 100, rays: int = 48) -> tuple[Array, list[str]]:
    """Return the percentages (3,) of invisible, unsolid and open rays, and the names of what most of them meet."""
    rng, area, solids = np.random.default_rng(seed), flight_area(world, seed), solid_space(world, seed)
    low, high = area.space.low, area.space.high
    origins = rng.uniform(low, high, (40 * points, 3))
    origins = origins[solids.clearance(origins) > 0.2][:points]
    along = rng.standard_normal((rays, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    colliding, seen = collision_spec(world, seed).compile(), instance_spec(world, seed).compile()
    solid = first_hits(colliding, origins, along, _COLLISION_GROUP)
    visible = first_hits(seen, origins, along, _VISIBLE_GROUP)
    solid_m, seen_m = solid.ranges_m, visible.ranges_m
    bound_m = np.where(along > 0.0, (high - origins[:, None]) / along, (low - origins[:, None]) / along).min(axis=2)
    until_m = np.minimum(seen_m, bound_m)
    invisible = solid_m + _TOLERANCE_M < until_m
    for k, s in np.argwhere(invisible):
        steps = np.arange(solid_m[k, s], until_m[k, s], _STEP_M) + 0.5 * _STEP_M
        inside = solids.clearance(origins[k] + steps[:, None] * along[s]) < 0.0
        invisible[k, s] = inside.sum() * _STEP_M > _TOLERANCE_M
    unsolid = seen_m + _TOLERANCE_M < np.minimum(solid_m, bound_m)
    names = np.array([seen.geom(k).name for k in range(seen.ngeom)] + [""])
    met = names[visible.geoms]
    unsolid &= ~np.char.startswith(met, "fern")
    blocks = np.array([colliding.geom(k).name for k in range(colliding.ngeom)] + [""])[solid.geoms]
    invisible &= ~np.char.startswith(blocks, "glass_part")
    has_leaves = np.logical_or.reduce([np.char.startswith(met, kind) for kind in _LEAFY])
    is_inside_mover = visible.from_behind.mean(axis=1, keepdims=True) > 0.5  # no solid of the world
    is_open = visible.from_behind & ~has_leaves & ~is_inside_mover
    worst = [*blocks[invisible], *met[unsolid], *met[is_open]]
    common = Counter(str(name).rsplit("_part", 1)[0] for name in worst).most_common(3)
    return 100.0 * np.array([kind.mean() for kind in (invisible, unsolid, is_open)]), [name for name, _ in common]


def main() -> None:
    """Print a row for each world and seed."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("worlds", nargs="*", default=list(WORLDS), metavar="WORLD")
    parser.add_argument("--seeds", type=int, default=3)
    chosen = parser.parse_args()
    rows = []
    for world in chosen.worlds:
        for seed in range(chosen.seeds):
            percent, worst = measured(world, seed)
            cells = {
                f"{kind} (%)": f"{p:.2f}" for kind, p in zip(("invisible", "unsolid", "open"), percent, strict=True)
            }
            rows.append({"world": world, "seed": str(seed), **cells, "worst": ", ".join(worst) or "–"})
    print_rows("What collides is what is seen", rows, ("worst",))


if __name__ == "__main__":
    main()
