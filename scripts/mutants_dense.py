"""Mutants of dense reconstruction."""

from mutant import Mutant

_DEPTH = "tests/estimator/dense/test_depth.py"
_SURFACES = "tests/estimator/dense/test_surfaces.py"

DENSE = (
    Mutant(
        "dense-stale-depths",
        "Pipeline: the poses of the images are not part of the hash of a depth map.",
        "estimator/dense/views.py",
        "return self.camera.K, self.T_world_cam, self.grey, self.mask",
        "return self.camera.K, self.camera.K, self.grey, self.mask",
        (f"{_SURFACES}::test_stored_depths_belong_to_their_input",),
    ),
    Mutant(
        "dense-unconfirmed-depths",
        "Consistency: depths that no other depth map confirms are kept.",
        "estimator/dense/consistency.py",
        "is_kept = count >= config.min_views",
        "is_kept = count >= 0",
        (f"{_SURFACES}::test_wrong_depths_are_dropped",),
    ),
    Mutant(
        "dense-depths-not-compared",
        "Consistency: only the pixels of a point are compared, not its depths.",
        "estimator/dense/consistency.py",
        "    agrees &= np.abs(seen - w) <= np.float32(config.max_depth_ratio) * w\n",
        "",
        (f"{_SURFACES}::test_wrong_depths_are_dropped",),
    ),
    Mutant(
        "dense-worst-neighbours",
        "Sweep: the cost is that of the neighbours that match worst.",
        "estimator/dense/sweep.py",
        "lowest[k], cost = np.minimum(lowest[k], cost), np.maximum(lowest[k], cost)",
        "lowest[k], cost = np.maximum(lowest[k], cost), np.minimum(lowest[k], cost)",
        (f"{_DEPTH}::test_depths_of_a_ball_and_a_wall", f"{_DEPTH}::test_depths_of_a_slanted_plane"),
    ),
    Mutant(
        "dense-one-direction",
        "Depth maps: planes are swept along the optical axis alone.",
        "estimator/dense/depth.py",
        "for axis in axes]",
        "for axis in axes[:1]]",
        (f"{_DEPTH}::test_a_grazing_plane_needs_its_normal",),
    ),
    Mutant(
        "dense-parabola-mirrored",
        "Semi-global matching: the vertex of the parabola is on the wrong side.",
        "estimator/dense/sgm.py",
        "0.5 * (before - after)",
        "0.5 * (after - before)",
        (f"{_DEPTH}::test_the_vertex_of_a_parabola",),
    ),
    Mutant(
        "dense-jumps-without-penalty",
        "Semi-global matching: a large change of the depth costs nothing.",
        "estimator/dense/sgm.py",
        "np.minimum(paths, lowest + P2)",
        "np.minimum(paths, lowest)",
        (f"{_DEPTH}::test_paths_prefer_smooth_depths_by_hand",),
    ),
    Mutant(
        "dense-mesh-inside-out",
        "Mesh: the triangles are clockwise as seen from outside.",
        "estimator/dense/surface_nets.py",
        "quads[:, ::-1], quads)",
        "quads, quads[:, ::-1])",
        (f"{_SURFACES}::test_the_mesh_of_a_ball_is_closed_and_round",),
    ),
    Mutant(
        "dense-completeness-is-accuracy",
        "Metrics: completeness is computed from the estimated points.",
        "eval/metrics/clouds.py",
        "float(np.mean(to_estimated <= d))",
        "float(np.mean(to_true <= d))",
        ("tests/eval/metrics/test_clouds_by_hand.py::test_scores_of_four_points_by_hand",),
    ),
)
