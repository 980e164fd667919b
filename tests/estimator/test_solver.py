"""The solver: a window that is linearised anew says the same, and holds the same factors."""

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, V, X

from dronevio.estimator.solver import FixedLagSolver, insert_state, stamps_of

STEP_NS = 200_000_000


def chain(keyframes: int, lag_s: float = 1.0, off: float = 0.1) -> tuple[FixedLagSolver, list[int]]:
    """A prior and a chain of relative poses, whose first guess is ``off`` [rad and m]."""
    solver = FixedLagSolver(lag_s, relinearise_threshold=0.01)
    noise, bias = gtsam.noiseModel.Isotropic.Sigma(6, 0.01), gtsam.imuBias.ConstantBias()
    step = gtsam.Pose3(gtsam.Rot3.Rz(0.4), np.array([0.3, 0.1, 0.0]))
    slots: list[int] = []
    truth = gtsam.Pose3()
    for k in range(keyframes):
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        if k == 0:
            graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), noise))
        else:
            graph.add(gtsam.BetweenFactorPose3(X(k - 1), X(k), step, noise))
        graph.add(gtsam.PriorFactorVector(V(k), np.full(3, 0.1 * k), gtsam.noiseModel.Isotropic.Sigma(3, 0.1)))
        graph.add(gtsam.PriorFactorConstantBias(B(k), bias, gtsam.noiseModel.Isotropic.Sigma(6, 0.1)))
        guess = truth.retract(np.full(6, off if k else 0.0))
        insert_state(values, k, gtsam.NavState(guess, np.zeros(3)), bias)
        truth = truth.compose(step)
        slots = solver.update(graph, values, stamps_of(k, k * STEP_NS))
    return solver, slots


def test_reads_back_what_the_factors_say() -> None:
    solver, _ = chain(4, lag_s=10.0)
    for _ in range(3):
        solver.update(gtsam.NonlinearFactorGraph(), gtsam.Values(), {})
    assert solver.keyframes == [0, 1, 2, 3]
    turned = gtsam.Rot3.Rz(1.2).matrix()
    np.testing.assert_allclose(solver.pose(3).rotation().matrix(), turned, atol=1e-6)
    np.testing.assert_allclose(solver.velocity(3), 0.3, atol=1e-9)


def test_linearised_anew_the_window_says_the_same() -> None:
    solver, _ = chain(12, off=1e-4)
    keyframes = solver.keyframes
    assert 0 not in keyframes  # some were marginalised
    before = [(solver.pose(k).matrix(), solver.velocity(k), solver.covariance(k)) for k in keyframes]
    solver.linearise_anew()
    assert solver.keyframes == keyframes
    for k, (pose, velocity, covariance) in zip(keyframes, before, strict=True):
        np.testing.assert_allclose(solver.pose(k).matrix(), pose, atol=1e-6)
        np.testing.assert_allclose(solver.velocity(k), velocity, atol=1e-6)
        np.testing.assert_allclose(solver.covariance(k), covariance, rtol=1e-3, atol=1e-7)


def test_linearised_anew_nothing_is_far_from_its_linearisation() -> None:
    solver, _ = chain(12)
    for _ in range(3):
        solver.linearise_anew()
    assert solver.drift_from_linearisation() < 1e-3


def test_slots_lead_to_the_same_factors() -> None:
    solver, slots = chain(12)
    moved = solver.linearise_anew()
    assert set(slots) <= set(moved) and len(set(moved.values())) == len(moved)
    # Without the factors of the newest keyframe, its velocity is free: the system has no solution any more.
    graph = gtsam.NonlinearFactorGraph()
    loose = gtsam.noiseModel.Isotropic.Sigma(3, 1.0)
    graph.add(gtsam.PriorFactorVector(V(11), np.full(3, 7.0), loose))
    solver.update(graph, gtsam.Values(), {}, [moved[slots[1]]])
    np.testing.assert_allclose(solver.velocity(11), 7.0, atol=1e-9)
