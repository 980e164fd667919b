"""Placement of a recorded path in a world by a rotation about the vertical and a translation."""

import numpy as np
from scipy.interpolate import RegularGridInterpolator
from scipy.optimize import minimize

from dronevio.models.arrays import Array
from dronevio.models.errors import ConfigError
from dronevio.models.rotation import pose_matrix, rotation_z
from dronevio.sim.paths.space import Space

_ENOUGH_M = 0.6  # clearance beyond this has no value
_SPACING_M = 0.1  # between the evaluated points of the path
_TURNS = 24  # candidate headings
_SHIFTS = 9  # candidate positions along each horizontal axis
_HEIGHTS = 4
_CELL_M = 0.3  # cell of the clearance map of the search
_REFINED = 6  # number of best candidates that are refined with exact clearances
_LOW_IS_GOOD = 0.01  # clearance equivalent of a metre of height: prefers low placements


def place_path(positions_m: Array, space: Space, margin_m: float, world: str) -> Array:
    """Return T_world_path (4, 4), a rotation about z and a translation, that keeps a path clear of all surfaces.

    Args:
        positions_m: (N, 3) The path, z up [m].
        space: Bounds and obstacles of the world.
        margin_m: Smallest distance to any surface [m].
        world: Name of the world, for the error.

    Raises:
        ConfigError: No placement has the clearance.
    """
    points = _thinned(positions_m)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    lookup = _clearance_map(space)

    def cost(clearance: Array, height: Array) -> Array:
        return -np.minimum(clearance, _ENOUGH_M) + _LOW_IS_GOOD * height

    places, costs = [], []
    for angle in np.arange(_TURNS) * (2.0 * np.pi / _TURNS):
        turned = (points - middle) @ rotation_z(angle).T
        shifts = _shifts(turned, space)
        clearance = lookup((shifts[:, None] + turned).reshape(-1, 3)).reshape(len(shifts), -1).min(axis=1)
        places.append(np.column_stack([np.full(len(shifts), angle), shifts]))
        costs.append(cost(clearance, shifts[:, 2]))
    ranked = np.concatenate(places)[np.argsort(np.concatenate(costs), kind="stable")[:_REFINED]]

    def exact_cost(place: Array) -> float:
        clearance = space.clearance((points - middle) @ rotation_z(place[0]).T + place[1:]).min()
        return float(cost(clearance, place[3]))

    refined = [
        minimize(exact_cost, start, method="Nelder-Mead", options={"maxiter": 150, "initial_simplex": _around(start)})
        for start in ranked
    ]
    best = min(refined, key=lambda result: float(result.fun)).x
    R = rotation_z(best[0])
    T_world_path = pose_matrix(R, best[1:] - R @ middle)
    clearance = float(space.clearance(positions_m @ R.T + T_world_path[:3, 3]).min())
    if clearance < margin_m:
        size = " × ".join(f"{v:.1f}" for v in np.ptp(points, axis=0))
        raise ConfigError(
            f"a path of {size} m in world {world!r} comes within {clearance:.2f} m of a surface in every placement;"
            f" expected at least {margin_m:g} m: try a larger world"
        )
    return T_world_path


def _thinned(positions_m: Array) -> Array:
    """Return points (M, 3) of the path at intervals of about `_SPACING_M`."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(positions_m, axis=0), axis=1))])
    wanted = np.arange(0.0, along[-1] + _SPACING_M, _SPACING_M)
    rows = np.clip(np.searchsorted(along, wanted), 0, len(along) - 1)
    return np.asarray(positions_m[np.unique(rows)])


def _clearance_map(space: Space) -> RegularGridInterpolator:
    """Return an approximate function from points (N, 3) to clearances (N,) [m] by interpolation on a grid."""
    axes = [
        np.linspace(low, high, max(2, round((high - low) / _CELL_M) + 1))
        for low, high in zip(space.low, space.high, strict=True)
    ]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return RegularGridInterpolator(axes, space.clearance(grid), bounds_error=False, fill_value=-1.0)


def _shifts(turned: Array, space: Space) -> Array:
    """Return the candidate translations (S, 3) of a path around the origin that keep it inside the bounds."""
    low, high = space.low - turned.min(axis=0), space.high - turned.max(axis=0)
    axes = []
    for least, greatest, count in zip(low, high, (_SHIFTS, _SHIFTS, _HEIGHTS), strict=True):
        axes.append(np.linspace(least, greatest, count + 2)[1:-1] if greatest > least else [0.5 * (least + greatest)])
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _around(place: Array) -> Array:
    """Return the initial simplex (5, 4) of the refinement of a placement (4,)."""
    return np.asarray(place + np.vstack([np.zeros(4), np.diag([0.1, 0.3, 0.3, 0.2])]))
