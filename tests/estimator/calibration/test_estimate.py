"""The information filter over windows, and what of it is applied, by hand."""

from dataclasses import replace

import numpy as np
import pytest

from dronevio.estimator.calibration.config import CalibratedPart, CalibrationConfig
from dronevio.estimator.calibration.corrections import GRAVITY, Corrections, inverse_depth_errors
from dronevio.estimator.calibration.estimate import ParameterEstimate, covariance_inflation, inflation_share
from dronevio.estimator.calibration.parameters import FIXED_SIGMA, ParameterTable
from dronevio.estimator.calibration.significance import STATIONARY_SIGMAS, SignificanceTest
from dronevio.estimator.types import Calibration
from dronevio.models.arrays import Array
from dronevio.models.rig_presets import rig_named

CONFIG = CalibrationConfig()
PARAMETERS = ParameterTable.of(CONFIG, 1)
PRIOR = ParameterEstimate.prior(PARAMETERS)
TEST = SignificanceTest.of_window(CONFIG, 1, begins_stationary=False, is_complete=True)
CERTAIN = 1e-14 * np.eye(13)
EACH = np.eye(13)


def corrections(time_offset_s: float = 0.0, x_rad: float = 0.0, gravity_m_s2: float = 0.0) -> Array:
    """Return the vector of corrections of one camera."""
    mean = np.zeros(13)
    mean[[0, GRAVITY, 3]] = time_offset_s, gravity_m_s2, x_rad
    return mean


def test_all_parameters_but_the_gyroscope_and_the_position_of_one_camera_are_corrected() -> None:
    rows = [group.rows.tolist() for group in PARAMETERS.groups]
    assert rows == [[0], [GRAVITY], [3, 4, 5], [9], [10, 11], [12]]
    np.testing.assert_array_equal(np.flatnonzero(PARAMETERS.is_unknown), [0, 1, 2, 3, 4, 5, 9, 10, 11, 12])
    sigmas = [0.01, 0.03, CONFIG.gyro_scale_sigma, 0.02, 0.02, 0.02, *[FIXED_SIGMA] * 3, 0.02, 0.01, 0.01, 0.01]
    np.testing.assert_allclose(PARAMETERS.sigmas, sigmas)
    np.testing.assert_allclose(PARAMETERS.walk, [1e-5, 0.0, 0.0, *[1e-5] * 3, *[0.0] * 3, *[1e-6] * 4])


def test_corrections_are_plausible_each_and_together() -> None:
    """The sum of ten squares is 10 ± √20: 32.4 is five standard deviations above the mean, 1.8² each."""
    one, of_all = corrections(x_rad=1.0) * PARAMETERS.sigmas, np.where(PARAMETERS.is_unknown, PARAMETERS.sigmas, 0.0)
    for applied, mean, largest in ((one, 0.0 * one, 5.0), (0.0 * one, of_all, 1.8)):
        assert PARAMETERS.are_plausible(0.99 * largest * applied, -0.99 * largest * mean)
        assert not PARAMETERS.are_plausible(1.01 * largest * applied, -1.01 * largest * mean)
        assert replace(PARAMETERS, max_sigmas=np.inf).are_plausible(1e3 * applied, 1e3 * mean)


def test_uncertainty_grows_from_window_to_window() -> None:
    """By the random walk over four seconds; before the first window, nothing is added."""
    first = PRIOR.predicted(1_000_000_000, PARAMETERS.walk)
    np.testing.assert_array_equal(first.covariance, PRIOR.covariance)
    second = first.predicted(5_000_000_000, PARAMETERS.walk)
    np.testing.assert_allclose(
        np.diag(second.covariance - first.covariance)[[0, 1, 2, 3]], [4e-10, 0.0, 0.0, 4e-10], rtol=1e-6
    )


def test_the_result_of_a_part_of_a_window_is_not_kept() -> None:
    mean, covariance = corrections(time_offset_s=0.002), 0.5 * PRIOR.covariance
    part = PRIOR.fused(mean, covariance, is_complete=False)
    assert not part.mean.any()
    np.testing.assert_array_equal(part.covariance, PRIOR.covariance)
    np.testing.assert_array_equal(part.newest_covariance, covariance)
    window = part.fused(mean, covariance, is_complete=True)
    np.testing.assert_array_equal(window.mean, mean)
    np.testing.assert_array_equal(window.covariance, window.newest_covariance)


def test_what_is_not_applied_is_an_error_of_the_calibration() -> None:
    """3 mrad that are too small to be applied count, beside 4 mrad that are not known; what is applied does not."""
    covariance = PRIOR.covariance.copy()
    covariance[3, 3] = 0.004**2
    for is_complete in (False, True):
        kept = PRIOR.fused(corrections(x_rad=0.003), covariance, is_complete=is_complete)
        assert kept.corrected(kept.newest_mean, covariance, PARAMETERS, TEST, is_complete=True) is None
        assert kept.errors(EACH)[3] == pytest.approx(0.005)
        np.testing.assert_allclose(kept.errors(EACH)[4:], PARAMETERS.sigmas[4:])
        applied = kept.fused(corrections(x_rad=0.015), covariance, is_complete=is_complete)
        applied = applied.corrected(applied.newest_mean, covariance, PARAMETERS, TEST, is_complete=True) or applied
        assert applied.applied[3] == 0.015
        assert applied.errors(EACH)[3] == pytest.approx(0.004)


def test_a_corrected_parameter_follows_the_estimate() -> None:
    """Also by less than the smallest correction, where another parameter is corrected."""
    first = PRIOR.corrected(corrections(time_offset_s=0.004, x_rad=0.002), CERTAIN, PARAMETERS, TEST, is_complete=True)
    assert first is not None
    np.testing.assert_array_equal(first.applied, corrections(time_offset_s=0.004))
    assert first.follows.tolist() == [True] + [False] * 12
    second = first.corrected(
        corrections(time_offset_s=0.0041, x_rad=0.015), CERTAIN, PARAMETERS, TEST, is_complete=True
    )
    assert second is not None
    np.testing.assert_array_equal(second.applied, corrections(time_offset_s=0.0041, x_rad=0.015))
    np.testing.assert_allclose(second.newest_change, corrections(time_offset_s=0.0001, x_rad=0.015), atol=1e-12)
    assert second.corrected(second.applied, CERTAIN, PARAMETERS, TEST, is_complete=True) is None


@pytest.mark.parametrize(("sigmas", "is_applied"), [(2.9, False), (3.1, True)])
def test_a_first_correction_exceeds_three_standard_deviations(sigmas: float, is_applied: bool) -> None:
    covariance = CERTAIN.copy()
    covariance[0, 0] = (0.004 / sigmas) ** 2
    corrected = PRIOR.corrected(corrections(time_offset_s=0.004), covariance, PARAMETERS, TEST, is_complete=True)
    assert (corrected is not None) == is_applied
    from_rest, mean = replace(TEST, min_sigmas=STATIONARY_SIGMAS), corrections(time_offset_s=0.004)
    assert PRIOR.corrected(mean, covariance, PARAMETERS, from_rest, is_complete=True) is None


def test_intrinsics_are_corrected_by_complete_windows_only() -> None:
    mean = corrections(time_offset_s=0.004)
    mean[[9, 10, 12]] = 0.02, 0.01, -0.01
    whole, part = (
        SignificanceTest.of_window(CONFIG, 1, begins_stationary=True, is_complete=is_complete)
        for is_complete in (True, False)
    )
    by_whole, by_part = (PRIOR.corrected(mean, CERTAIN, PARAMETERS, test, is_complete=True) for test in (whole, part))
    assert by_whole is not None and by_part is not None
    np.testing.assert_array_equal(by_whole.applied, mean)
    np.testing.assert_array_equal(by_part.applied, corrections(time_offset_s=0.004))


def test_a_correction_beyond_the_prior_refutes_it() -> None:
    """The prior draws a focal length that is 6 % off, by a window with a standard deviation of 1 %, to 4.8 %.

    Its standard deviation becomes 4.8 % instead of 2 %. One correction within the prior stays, and one that is not
    applied does.
    """
    covariance, mean = np.diag(PARAMETERS.sigmas**2), np.zeros(13)
    covariance[[9, 10, 12], [9, 10, 12]] = 1.0 / (0.02**-2 + 0.01**-2), 1e-8, 1e-8
    mean[[9, 10, 12]] = 0.048, 0.009, 0.004
    found = PRIOR.corrected(mean, covariance, PARAMETERS, TEST, is_complete=True)
    assert found is not None
    expected_variance = 1.0 / (0.048**-2 + 0.01**-2)
    expected = mean.copy()
    expected[9] = expected_variance * 0.06 * 0.01**-2
    np.testing.assert_allclose(found.mean, expected, atol=1e-12)
    np.testing.assert_allclose(found.covariance[9, 9], expected_variance)
    np.testing.assert_allclose(np.delete(np.diag(found.covariance), 9), np.delete(np.diag(covariance), 9))
    expected[12] = 0.0
    np.testing.assert_allclose(found.applied, expected, atol=1e-12)
    np.testing.assert_array_equal(found.newest_change, found.applied)
    part = PRIOR.corrected(mean, covariance, PARAMETERS, TEST, is_complete=False)
    assert part is not None and not part.mean.any()


def test_intrinsics_are_very_wrong_beyond_their_prior() -> None:
    """A focal length by 1.4 %, a radial coefficient by 0.015; whatever another part is."""
    for row, limit in ((9, 0.014), (10, 0.015), (12, 0.015)):
        change = corrections(time_offset_s=0.05, x_rad=0.1)
        change[row] = -0.99 * limit
        assert not PARAMETERS.refutes_intrinsics(change)
        change[row] = -1.01 * limit
        assert PARAMETERS.refutes_intrinsics(change)


def test_an_implausible_correction_is_remembered() -> None:
    wrong = PRIOR.corrected(corrections(time_offset_s=0.051), CERTAIN, PARAMETERS, TEST, is_complete=True)
    assert wrong is not None and not wrong.is_plausible
    later = wrong.corrected(corrections(time_offset_s=0.049), CERTAIN, PARAMETERS, TEST, is_complete=True)
    assert later is not None and not later.is_plausible
    plausible = PRIOR.corrected(corrections(time_offset_s=0.049), CERTAIN, PARAMETERS, TEST, is_complete=True)
    assert plausible is not None and plausible.is_plausible


@pytest.mark.parametrize(
    ("change", "share"),
    [
        (corrections(time_offset_s=-0.002), 0.4),
        (corrections(x_rad=np.radians(0.5)), 0.5),
        (corrections(time_offset_s=0.004, x_rad=np.radians(0.5)), 0.8),
        (corrections(time_offset_s=0.02), 1.0),
        (corrections(time_offset_s=1e-6), 0.03),
    ],
)
def test_inflation_is_proportional_to_the_correction(change: Array, share: float) -> None:
    assert inflation_share(change) == pytest.approx(share)
    sigmas = np.sqrt(np.diag(covariance_inflation(change, CONFIG)))
    np.testing.assert_allclose(sigmas, share * np.repeat(CONFIG.inflation_sigmas, 3))


def test_inflation_by_positions_is_whole_and_by_gravity_its_own() -> None:
    assert inflation_share(1e-4 * np.eye(13)[6]) == 1.0
    for row in (9, 10, 11, 12):  # focal length, principal point, radial distortion
        assert inflation_share(0.01 * np.eye(13)[row]) == pytest.approx(0.01 / np.radians(1.0))
    sigmas = np.sqrt(np.diag(covariance_inflation(corrections(gravity_m_s2=0.02), CONFIG)))
    np.testing.assert_allclose(sigmas, np.repeat(CONFIG.gravity_inflation_sigmas, 3))


def test_settings_of_a_part_that_is_off_do_not_matter() -> None:
    off = replace(CONFIG.time_offset, online=False)
    table = ParameterTable.of(replace(CONFIG, time_offset=off), 1)
    assert table.sigmas[0] == FIXED_SIGMA and not table.walk[0] and len(table.groups) == 5
    assert Corrections.from_vector(table.sigmas).gravity_m_s2 == CONFIG.gravity.sigma


def rotation_or_principal_point(seen_rad: float) -> tuple[Array, Array]:
    """Return an estimate that knows the view about y to 1 mrad; rotation and principal point have priors of 10 mrad."""
    covariance, view = CERTAIN.copy(), np.zeros(13)
    covariance[[4, 10], [4, 10]] = 0.01**2
    view[[4, 10]] = 1.0, -1.0
    information = np.linalg.inv(covariance) + np.outer(view, view) / 0.001**2
    posterior = np.asarray(np.linalg.inv(information))
    return posterior @ view * seen_rad / 0.001**2, posterior


def test_rotations_are_corrected_for_the_intrinsics_in_use() -> None:
    """An error of the view of 15 mrad is given half to each, of which neither is significant, and corrected by one."""
    mean, covariance = rotation_or_principal_point(0.015)
    np.testing.assert_allclose(mean[[4, 10]], [0.0075, -0.0075], rtol=0.01)
    found = PRIOR.corrected(mean, covariance, PARAMETERS, TEST, is_complete=True)
    assert found is not None and found.follows[4] and not found.follows[10]
    assert found.applied[4] == pytest.approx(0.015, rel=0.02) and found.applied[10] == 0.0
    np.testing.assert_array_equal(found.mean, mean)


def test_rotations_are_not_corrected_for_intrinsics_that_are_refuted() -> None:
    """The radial distortion, which a part of a window does not correct, contradicts the estimate."""
    mean, covariance = rotation_or_principal_point(0.03)
    covariance[12, 12], mean[12] = 0.001**2, 0.02
    part = SignificanceTest.of_window(CONFIG, 1, begins_stationary=True, is_complete=False)
    part = replace(part, min_sigmas=1.0)
    found = PRIOR.corrected(mean, covariance, PARAMETERS, part, is_complete=False)
    assert found is None or found.applied[4] == mean[4]
    agreeing = mean.copy()
    agreeing[12] = 0.0
    found = PRIOR.corrected(agreeing, covariance, PARAMETERS, part, is_complete=False)
    assert found is not None and found.applied[4] == pytest.approx(0.03, rel=0.02)


STEREO = Calibration(rig_named("euroc-stereo"))
OF_TWO = ParameterTable.of(CONFIG, 2, inverse_depth_errors(STEREO))
PARALLAX = OF_TWO.inverse_depth_errors[2]
SECOND_TURNED = 14
"""Row of the rotation of the second camera about its y axis, across the baseline."""


def test_cameras_whose_calibration_is_refuted_must_be_known_for_depths() -> None:
    """The given calibration determines depths, whatever its prior; a corrected one by its covariance."""
    prior, test = (
        ParameterEstimate.prior(OF_TWO),
        SignificanceTest.of_window(CONFIG, 2, begins_stationary=False, is_complete=True),
    )
    assert prior.cameras_without_depth(OF_TWO) == frozenset()
    mean = np.zeros(23)
    mean[SECOND_TURNED - 1] = 0.05  # about its x axis
    for sigma, without in ((0.02, frozenset({1})), (0.0001, frozenset())):
        covariance = 1e-12 * np.eye(23)
        covariance[SECOND_TURNED, SECOND_TURNED] = sigma**2
        found = prior.corrected(mean, covariance, OF_TWO, test, is_complete=True)
        assert found is not None and found.follows[3]
        assert found.cameras_without_depth(OF_TWO) == without
    only_time = prior.corrected(
        corrections_of_two(0.004), OF_TWO.sigmas**2 * 1e-4 * np.eye(23), OF_TWO, test, is_complete=True
    )
    assert only_time is not None and only_time.cameras_without_depth(OF_TWO) == frozenset()


def test_a_refuted_calibration_is_known_by_the_rotation_of_the_first_camera() -> None:
    """A window of the matches alone refutes the cameras, but leaves the rotation that they have in common."""
    prior, test = (
        ParameterEstimate.prior(OF_TWO),
        SignificanceTest.of_window(CONFIG, 2, begins_stationary=False, is_complete=True),
    )
    assert prior.is_known(OF_TWO) and not prior.is_refuted(OF_TWO)
    mean, view = np.zeros(23), [3, 4, 5, 10, 11]  # rotation and principal point of the first camera
    mean[SECOND_TURNED] = 0.05
    for share, is_known in ((0.6, False), (0.4, True)):
        covariance = 1e-12 * np.eye(23)
        covariance[view, view] = (share * OF_TWO.sigmas[view]) ** 2
        found = prior.corrected(mean, covariance, OF_TWO, test, is_complete=True)
        assert found is not None and found.is_refuted(OF_TWO)
        assert found.is_known(OF_TWO) == is_known


def test_a_refuted_focal_length_is_known_where_no_rotation_is_corrected() -> None:
    off = CalibratedPart(False, 0.02, 0.0, 0.0)
    parameters = ParameterTable.of(replace(CONFIG, rotation=off, principal=off), 1)
    test = SignificanceTest.of_window(CONFIG, 1, begins_stationary=False, is_complete=True)
    mean = np.zeros(13)
    mean[9] = 0.03
    found = ParameterEstimate.prior(parameters).corrected(mean, CERTAIN, parameters, test, is_complete=True)
    assert found is not None and found.is_refuted(parameters) and found.is_known(parameters)


def corrections_of_two(time_offset_s: float) -> Array:
    mean = np.zeros(23)
    mean[0] = time_offset_s
    return mean


def test_rotations_and_intrinsics_are_corrected_together_for_depths() -> None:
    """A part of a window corrects no focal length, but that of the second camera leaves inverse depths 0.04 1/m off."""
    prior, certain = ParameterEstimate.prior(OF_TWO), 1e-12 * np.eye(23)
    part = SignificanceTest.of_window(CONFIG, 2, begins_stationary=True, is_complete=False)
    mean = np.zeros(23)
    mean[3], mean[19] = 0.03, 0.012
    assert 0.03 < OF_TWO.inverse_depth_errors[3] @ np.where(np.arange(23) == 19, mean, 0.0) < 0.06
    found = prior.corrected(mean, certain, OF_TWO, part, is_complete=False)
    assert found is not None
    np.testing.assert_allclose(found.applied, mean, atol=1e-12)
    assert found.follows[OF_TWO.is_of_images].all() and not found.follows[~OF_TWO.is_of_images].any()
    alone = prior.corrected(mean, certain, ParameterTable.of(CONFIG, 2), part, is_complete=False)
    assert alone is not None and alone.applied[19] == 0.0


def test_the_prior_widens_where_a_parameter_itself_is_refuted() -> None:
    """Intrinsics that are corrected for the sake of the depths keep theirs."""
    prior = ParameterEstimate.prior(OF_TWO)
    part = SignificanceTest.of_window(CONFIG, 2, begins_stationary=True, is_complete=False)
    covariance, mean = 1e-12 * np.eye(23), np.zeros(23)
    covariance[20, 20], mean[20], mean[3] = 0.0095**2, 0.03, 0.05
    found = prior.corrected(mean, covariance, OF_TWO, part, is_complete=False)
    assert found is not None and found.follows[20]
    assert found.applied[20] == pytest.approx(0.03)
    assert found.newest_covariance[20, 20] == pytest.approx(0.0095**2)
