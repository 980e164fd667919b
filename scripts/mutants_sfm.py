"""Mutants of structure from motion."""

from mutant import Mutant

_MAPPER = "tests/estimator/sfm/test_mapper.py"
_INERTIAL = "tests/estimator/sfm/test_inertial.py"
_TWO_VIEW = "tests/estimator/sfm/test_two_view.py"
_EARLIER = "tests/estimator/sfm/test_earlier.py"

SFM = (
    Mutant(
        "sfm-matches-not-mutual",
        "Matching: a nearest neighbour in one direction is enough.",
        "estimator/sfm/matching.py",
        "    rows, nearest = rows[is_mutual], nearest[is_mutual]\n",
        "",
        (f"{_TWO_VIEW}::test_no_feature_is_matched_twice",),
    ),
    Mutant(
        "sfm-no-ratio-test",
        "Matching: the second-nearest descriptor is ignored.",
        "estimator/sfm/matching.py",
        "(distance <= config.ratio * second_distance) & ",
        "",
        (f"{_TWO_VIEW}::test_ambiguous_features_are_not_matched",),
    ),
    Mutant(
        "sfm-planar-seeds",
        "Mapping: planar pairs and pure rotations are seeds as well.",
        "estimator/sfm/mapper.py",
        "p.geometry is Geometry.GENERAL and ",
        "",
        (f"{_MAPPER}::test_degenerate_pairs_are_not_seeds",),
    ),
    Mutant(
        "sfm-wrong-poses-stay",
        "Mapping: an image with a wrong pose stays registered.",
        "estimator/sfm/mapper.py",
        "inliers < self.config.min_support * visible",
        "inliers < 0",
        (f"{_MAPPER}::test_an_image_with_a_wrong_pose_is_registered_anew",),
    ),
    Mutant(
        "sfm-points-behind-cameras",
        "Two rays: points behind a camera are accepted.",
        "estimator/sfm/bearings.py",
        " & (s0 > 0.0) & (s1 > 0.0)",
        "",
        (f"{_MAPPER}::test_midpoints_by_hand",),
    ),
    Mutant(
        "sfm-small-angles",
        "Triangulation: the angle between the rays is not checked.",
        "estimator/sfm/triangulation.py",
        "    accepted = enough & wide\n",
        "    accepted = enough\n",
        (f"{_MAPPER}::test_small_angles_are_not_triangulated",),
    ),
    Mutant(
        "sfm-rig-without-factors",
        "Rig: the mounting of the cameras does not constrain the adjustment.",
        "estimator/sfm/adjustment.py",
        "    _add_rig(graph, rig)\n",
        "",
        ("tests/estimator/sfm/test_rig.py::test_a_stereo_rig_gives_metres",),
    ),
    Mutant(
        "sfm-tracks-in-conflict",
        "Tracks: a track may have two features of one image.",
        "estimator/sfm/tracks.py",
        "np.asarray(distinct < counts)",
        "np.asarray(distinct < 0)",
        ("tests/estimator/sfm/test_tracks.py::test_no_track_has_two_features_of_an_image",),
    ),
    Mutant(
        "sfm-stale-workspace",
        "Workspace: stored results are used whatever the input was.",
        "estimator/sfm/workspace.py",
        'return dict(file) if str(file["key"]) == key else None',
        "return dict(file)",
        ("tests/estimator/sfm/test_rig.py::test_stored_features_belong_to_their_settings",),
    ),
    Mutant(
        "sfm-known-pairs-matched-again",
        "Added images: the images of the earlier reconstruction are matched to each other again.",
        "estimator/sfm/pipeline.py",
        "if not (is_known[i] and is_known[j])",
        "if not (is_known[i] and is_known[j] and i == j)",
        (f"{_EARLIER}::test_earlier_images_are_not_matched_again",),
    ),
    Mutant(
        "sfm-similarity-without-scale",
        "World frame: the similarity transformation has no scale.",
        "estimator/sfm/gauge.py",
        "    scale = scale if scale > 0.0 else 1.0\n",
        "    scale = 1.0\n",
        (f"{_EARLIER}::test_similarity_by_hand",),
    ),
    Mutant(
        "sfm-far-features-identified",
        "Added images: an earlier observation is identified with any feature, however far.",
        "estimator/sfm/earlier.py",
        "        chosen = chosen[distance[chosen] <= MAX_DISTANCE_PX]\n",
        "",
        (f"{_EARLIER}::test_other_features_are_matched_anew",),
    ),
    Mutant(
        "sfm-imu-without-lever-arm",
        "IMU: the camera is taken to be at the position of the IMU.",
        "estimator/sfm/inertial.py",
        "R @ motion.p - intervals.lever_m[k]",
        "R @ motion.p",
        (f"{_INERTIAL}::test_gravity_scale_and_biases",),
    ),
    Mutant(
        "sfm-imu-time-offset-sign",
        "IMU: the time offset of the cameras has the wrong sign.",
        "estimator/sfm/inertial.py",
        "t_ns + round(inertial",
        "t_ns - round(inertial",
        (f"{_INERTIAL}::test_gravity_scale_and_biases",),
    ),
    Mutant(
        "sfm-imu-any-motion",
        "IMU: the scale is used however uncertain it is.",
        "estimator/sfm/world.py",
        "found.scale_sigma > config.max_scale_sigma",
        "found.scale_sigma > np.inf",
        (f"{_INERTIAL}::test_an_imu_that_does_not_suffice",),
    ),
)
