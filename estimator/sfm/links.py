"""Wrong links: matches of places that look alike, which have joined parts of a scene where they do not belong.

A part of the images that is joined to the others by wrong matches contradicts its right matches with them. Which of
both are wrong is decided by their number: every link of a maximum spanning tree of the images, weighted by matches, has
at least as many matches as any other link between the two parts that it connects.
"""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components, minimum_spanning_tree

from dronevio.estimator.sfm.two_view import ImageView, TwoView
from dronevio.models.arrays import Array, Mask

LARGEST_ERROR_PX = 4.0
"""Distance from the epipolar plane up to which a match agrees with two poses [px]."""
LEAST_AGREEING = 0.5
"""Share of the matches of a pair that agree if the pair does."""
LEAST_MATCHES = 50
"""Number of matches of a link of which contradicting ones are wrong."""
STRONGER = 2.0
"""Smallest ratio of the matches of a right link and of a wrong one."""


def wrong_links(pairs: Sequence[TwoView], views: Sequence[ImageView], Ts_world_cam: Array) -> npt.NDArray[np.intp]:
    """Return the indices of pairs that agree with the poses, and that much stronger pairs contradict; often none.

    Args:
        pairs: Verified pairs.
        views: Features of each image.
        Ts_world_cam: (I, 4, 4) Poses of the cameras; NaN for images that are not registered.
    """
    is_registered = np.isfinite(Ts_world_cam[:, 0, 3])
    chosen = np.array([k for k, p in enumerate(pairs) if is_registered[p.first] and is_registered[p.second]], np.intp)
    if not chosen.size:
        return chosen
    ends = np.array([(pairs[k].first, pairs[k].second) for k in chosen])
    counts = np.array([len(pairs[k].matches) for k in chosen])
    agrees = np.array([_agrees(pairs[k], views, Ts_world_cam) for k in chosen])
    # Links of the maximum spanning tree that contradict the poses, the strongest first
    tree = _spanning_tree(ends, counts, len(views))
    contradicted = tree[~agrees[tree] & (counts[tree] >= LEAST_MATCHES)]
    for link in contradicted[np.argsort(-counts[contradicted], kind="stable")]:
        part = _components(ends[tree[tree != link]], len(views))
        side = part == part[ends[link, 0]]
        joining = agrees & (side[ends[:, 0]] != side[ends[:, 1]])
        if joining.any() and counts[link] >= STRONGER * counts[joining].max():
            return np.asarray(chosen[joining])
    return chosen[:0]


def _agrees(pair: TwoView, views: Sequence[ImageView], Ts_world_cam: Array) -> bool:
    """Return whether most matches of a pair agree with the poses of its images."""
    first, second = Ts_world_cam[pair.first], Ts_world_cam[pair.second]
    R, t = second[:3, :3].T @ first[:3, :3], second[:3, :3].T @ (first[:3, 3] - second[:3, 3])
    x = views[pair.first].bearings[pair.matches[:, 0]] @ R.T
    y = views[pair.second].bearings[pair.matches[:, 1]]
    normals = np.cross(t, x)
    lengths = np.maximum(np.linalg.norm(normals, axis=1), 1e-12)
    errors_px = views[pair.second].focal_px * np.abs(np.vecdot(normals, y)) / lengths
    is_good: Mask = errors_px <= LARGEST_ERROR_PX  # False for NaN
    return bool(is_good.mean() >= LEAST_AGREEING)


def _spanning_tree(ends: npt.NDArray[np.intp], counts: npt.NDArray[np.intp], images: int) -> npt.NDArray[np.intp]:
    """Return the indices of the links of a maximum spanning forest."""
    cost = counts.max() + 1.0 - counts
    graph = coo_array((cost, (ends[:, 0], ends[:, 1])), shape=(images, images)).tocsr()
    first, second = minimum_spanning_tree(graph).tocoo().coords
    index = {(i, j): k for k, (i, j) in enumerate(ends.tolist())}
    return np.array([index[i, j] for i, j in zip(first.tolist(), second.tolist(), strict=True)], np.intp)


def _components(ends: npt.NDArray[np.intp], images: int) -> npt.NDArray[np.int32]:
    """Return the component (I,) of each image."""
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(images, images))
    return np.asarray(connected_components(graph, directed=False)[1])
