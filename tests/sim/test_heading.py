"""Heading profiles, and heading curves that follow them within limits."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.interpolate import BSpline

from dronevio.sim.paths.heading import HeadingProfile, across, along, fixed, heading_curve, spinning, toward
from dronevio.sim.paths.minimum_snap import minimum_snap

CIRCLE_S = 20.0


def circle(laps: int = 2) -> BSpline:
    angle = np.linspace(0.0, 2.0 * np.pi * laps, 12 * laps + 1)
    points = np.stack([2.0 * np.cos(angle), 2.0 * np.sin(angle), np.ones_like(angle)], axis=1)
    return minimum_snap(CIRCLE_S * angle / angle[-1], points)


def wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


def test_desired_headings_by_geometry() -> None:
    t = np.arange(3.0)
    position = np.array([[0.0, -2.0, 1.0], [2.0, 0.0, 1.0], [0.1, 0.0, 1.0]])
    velocity = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 5.0], [0.0, 0.01, 3.0]])
    np.testing.assert_allclose(along(t, position, velocity), [0.0, 0.5 * np.pi, np.nan])
    np.testing.assert_allclose(across(t, position, velocity), [0.5 * np.pi, np.pi, np.nan])
    np.testing.assert_allclose(toward(np.zeros(2))(t, position, velocity), [0.5 * np.pi, np.pi, np.nan])
    np.testing.assert_allclose(fixed(0.3)(t, position, velocity), 0.3)
    np.testing.assert_allclose(spinning(2.0, 4.0, 5.0)(np.arange(7.0), position, velocity), [0, 2, 4, 2, 0, 0, 2])


PROFILES: list[tuple[HeadingProfile, float]] = [(along, 0.5 * np.pi), (across, np.pi), (toward(np.zeros(2)), np.pi)]


@pytest.mark.parametrize(("profile", "offset"), PROFILES)
def test_heading_follows_the_profile_on_a_circle(profile: HeadingProfile, offset: float) -> None:
    path = circle()
    heading = heading_curve(profile, path, CIRCLE_S, 3.0, 0.0)
    t = np.linspace(4.0, CIRCLE_S - 3.0, 500)
    azimuth = np.arctan2(path(t)[:, 1], path(t)[:, 0])
    assert np.abs(wrapped(heading(t) - azimuth - offset)).max() < 0.2


@given(seed=st.integers(0, 1000), rate=st.floats(0.1, 6.0), end_s=st.floats(0.5, 60.0), start=st.floats(-3.0, 3.0))
@settings(max_examples=60, deadline=None)
def test_rate_and_angular_acceleration_are_limited(seed: int, rate: float, end_s: float, start: float) -> None:
    rng = np.random.default_rng(seed)

    def random_profile(t: np.ndarray, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        desired = np.repeat(rng.uniform(-10.0, 10.0, len(t)), rng.integers(1, 30))[: len(t)]
        return np.where(rng.random(len(t)) < 0.1, np.nan, desired)

    heading = heading_curve(random_profile, minimum_snap(np.array([0.0, end_s]), np.zeros((2, 3))), end_s, rate, start)
    t = np.linspace(0.0, end_s, 5000)
    assert np.abs(heading.derivative(1)(t)).max() <= rate
    assert np.abs(heading.derivative(2)(t)).max() <= 5.0 * (1.0 + 1e-9)
    assert heading(0.0) == pytest.approx(start)
    for order in (1, 2, 3):
        np.testing.assert_allclose(heading.derivative(order)([0.0, end_s]), 0.0, atol=1e-6)


def test_the_shorter_rotation_is_taken() -> None:
    path = minimum_snap(np.array([0.0, 10.0]), np.zeros((2, 3)))
    heading = heading_curve(fixed(np.radians(170.0)), path, 10.0, 2.0, np.radians(-170.0))
    assert np.degrees(heading(10.0)) == pytest.approx(-190.0, abs=0.1)


def test_steps_are_followed_without_overshoot() -> None:
    path = minimum_snap(np.array([0.0, 10.0]), np.zeros((2, 3)))
    heading = heading_curve(fixed(2.0), path, 10.0, 1.5, 0.0)(np.linspace(0.0, 10.0, 1000))
    assert heading[-1] == pytest.approx(2.0, abs=1e-3)
    assert heading.max() < 2.05
