"""Mutants of simultaneous localization and mapping."""

from mutant import Mutant

SLAM = (
    Mutant(
        "places-yaw-of-two-points",
        "Verification: sign of a term in the equation of the yaw of two matches.",
        "estimator/slam/gravity_pose.py",
        "n[:, 0] * D[:, 1] - n[:, 1] * D[:, 0]",
        "n[:, 0] * D[:, 1] + n[:, 1] * D[:, 0]",
        ("tests/estimator/slam/test_verification.py::test_two_matches_determine_the_pose_exactly",),
    ),
    Mutant(
        "places-biased-depths",
        "Verification: landmarks are linearized at their given depths, which biases the pose.",
        "estimator/slam/relative_pose.py",
        "        depth = part.depth\n",
        "",
        ("tests/estimator/slam/test_verification.py::test_the_covariance_is_consistent",),
    ),
    Mutant(
        "places-scale-is-certain",
        "Verification: the common error of the depths is not part of the covariance.",
        "estimator/slam/relative_pose.py",
        "config.scale_sigma**2 * sensitivity",
        "0.0 * sensitivity",
        ("tests/estimator/slam/test_verification.py::test_an_error_of_scale_is_part_of_the_covariance",),
    ),
    Mutant(
        "places-rivalling-poses",
        "Verification: another pose that explains nearly as many matches is ignored.",
        "estimator/slam/verification.py",
        "if len(competitors) and competitors.max() >",
        "if len(competitors) and -competitors.max() >",
        ("tests/estimator/slam/test_verification.py::test_two_poses_that_fit_equally_are_rejected",),
    ),
    Mutant(
        "places-one-direction",
        "Verification: the poses of the two directions need not agree.",
        "estimator/slam/verification.py",
        "if not _directions_agree(",
        "if False and not _directions_agree(",
        ("tests/estimator/slam/test_verification.py::test_both_directions_have_to_give_the_same_pose",),
    ),
    Mutant(
        "places-descriptors-without-lens",
        "Features: the direction of gravity is that of an image without distortion.",
        "estimator/slam/features.py",
        "direction = camera.project(rays + step) - camera.project(rays - step)",
        "direction = down_cam[:2] - xy * down_cam[2]",
        ("tests/estimator/slam/test_features.py::test_a_lens_distorts_the_direction_of_gravity",),
    ),
    Mutant(
        "places-drift-without-limit",
        "Recognition: a match may claim any drift of the odometry.",
        "estimator/slam/recognizer.py",
        "if query.track != match.track:",
        "if True:",
        ("tests/estimator/slam/test_recognizer.py::test_more_drift_than_possible_is_refused",),
    ),
    Mutant(
        "places-rivals-not-verified",
        "Recognition: the second of two equal places is not verified.",
        "estimator/slam/recognizer.py",
        "min(left, 1)",
        "0",
        ("tests/estimator/slam/test_recognizer.py::test_two_equal_places_are_ambiguous",),
    ),
    Mutant(
        "places-unconfirmed",
        "Recognition: a match is published although no other keyframe confirms it.",
        "estimator/slam/recognizer.py",
        "newest.result) if agreeing else ()",
        "newest.result)",
        ("tests/estimator/slam/test_recognizer.py::test_one_match_alone_is_not_published",),
    ),
    Mutant(
        "places-equal-weights",
        "Index: frequent words weigh as much as rare ones.",
        "estimator/slam/index.py",
        "np.asarray(np.log(1.0 + (len(self._sizes) + 1.0) / (self._documents[words] + 1.0)))",
        "np.ones(len(words))",
        ("tests/estimator/slam/test_index.py::test_a_word_of_every_keyframe_says_little",),
    ),
)
"""Faults of the recognition of places."""
