"""Batched Levenberg-Marquardt on problems with known answers."""

import numpy as np
import pytest

from fisheye_svp_ros.optics.engines.marquardt import FIRST_GROWTH, STEP_TOLERANCE, update_damping
from fisheye_svp_ros.solve.least_squares import (
    dense_step,
    levenberg_marquardt,
    never_singular,
    solve_damped,
)

# NIST StRD, Misra1a (lower difficulty): y = b1 (1 - exp(-b2 x)), certified values.
MISRA_X = np.array(
    [
        77.6,
        114.9,
        141.1,
        190.8,
        239.9,
        289.0,
        332.8,
        378.4,
        434.8,
        477.3,
        536.8,
        593.1,
        689.1,
        760.0,
    ]
)
MISRA_Y = np.array(
    [
        10.07,
        14.73,
        17.94,
        23.93,
        29.61,
        35.18,
        40.02,
        44.82,
        50.76,
        55.05,
        61.01,
        66.40,
        75.47,
        81.78,
    ]
)
MISRA_B = np.array([2.3894212918e2, 5.5015643181e-4])


class Curves:
    """S fits of one curve: `function` returns residuals (A, M) and their Jacobian (A, M, P)."""

    def __init__(self, function):
        self.function = function
        self.asked = []

    def linearize(self, state, index):
        self.asked.append(len(index))
        residual, jacobian = self.function(*state, index)
        hessian = np.einsum('smi,smj->sij', jacobian, jacobian)
        cost = (residual**2).sum(axis=1)
        outside = ~np.isfinite(cost)
        hessian[outside] = np.eye(hessian.shape[-1])
        gradient = np.where(outside[:, None], 0.0, np.einsum('smi,sm->si', jacobian, residual))
        return np.where(outside, np.inf, cost), (hessian, gradient)

    def step(self, normal, damping):
        return dense_step(normal, damping)

    def retract(self, state, step):
        return (state[0] + step[0],)


def misra(b, index):
    decay = np.exp(-b[:, 1:] * MISRA_X)
    residual = b[:, :1] * (1 - decay) - MISRA_Y
    return residual, np.stack([1 - decay, b[:, :1] * MISRA_X * decay], axis=-1)


def rosenbrock(b, index):
    x, y = b.T
    residual = np.stack([10 * (y - x * x), 1 - x], axis=-1)
    jacobian = np.stack([np.stack([-20 * x, 10 + 0 * x], -1), np.stack([0 * x - 1, 0 * x], -1)], 1)
    return residual, jacobian


def test_certified_values_from_both_certified_starts():
    solved = levenberg_marquardt(Curves(misra), (np.array([[500.0, 1e-4], [250.0, 5e-4]]),))
    assert solved.converged.all()
    np.testing.assert_allclose(solved.state[0], np.tile(MISRA_B, (2, 1)), rtol=1e-9)
    np.testing.assert_allclose(solved.cost, 1.2455138894e-1, rtol=1e-9)


def test_systems_are_independent_and_leave_when_done():
    starts = np.array([[-1.2, 1.0], [1.0, 1.0], [5.0, -3.0], [0.0, 40.0]])
    problem = Curves(rosenbrock)
    together = levenberg_marquardt(problem, (starts,))
    assert together.converged.all()
    np.testing.assert_allclose(together.state[0], 1.0, rtol=0, atol=1e-9)
    assert together.iterations[1] == 1
    assert problem.asked == sorted(problem.asked, reverse=True)
    assert problem.asked[-1] < 4
    for i, start in enumerate(starts):
        alone = levenberg_marquardt(Curves(rosenbrock), (start[None],))
        np.testing.assert_array_equal(alone.state[0][0], together.state[0][i])
        assert alone.iterations[0] == together.iterations[i]
    np.testing.assert_array_equal(starts[0], [-1.2, 1.0])


def test_steps_out_of_the_domain_are_refused():
    def logarithm(b, index):
        with np.errstate(invalid='ignore', divide='ignore'):
            return np.log(b) - 1, 1 / b[..., None]

    # From 20 the full step lands below zero, where there is no logarithm; -1 lies outside.
    solved = levenberg_marquardt(Curves(logarithm), (np.array([[20.0], [0.01], [-1.0]]),))
    assert solved.converged.tolist() == [True, True, False]
    np.testing.assert_allclose(solved.state[0][:2], np.e, rtol=1e-9)
    assert solved.state[0][2] == -1.0
    assert np.isinf(solved.cost[2])
    assert solved.iterations[2] == 0


def test_too_few_iterations_are_reported():
    solved = levenberg_marquardt(Curves(rosenbrock), (np.array([[-1.2, 1.0]]),), max_iterations=3)
    assert not solved.converged[0]
    assert solved.iterations[0] == 3


def test_no_system_at_all():
    solved = levenberg_marquardt(Curves(rosenbrock), (np.zeros((0, 2)),))
    assert solved.cost.shape == solved.converged.shape == (0,)


@pytest.mark.parametrize('damping', [0.0, 0.5])
def test_damped_step_solves_marquardts_equations(damping):
    rng = np.random.default_rng(41)
    jacobian = rng.normal(size=(3, 8, 4)) * 10.0 ** np.array([-6, 0, 3, 6])
    hessian = np.swapaxes(jacobian, 1, 2) @ jacobian
    gradient = rng.normal(size=(3, 4)) * np.sqrt(np.diagonal(hessian, axis1=1, axis2=2))
    step = solve_damped(hessian, gradient, np.full(3, damping))
    damped = hessian + damping * hessian * np.eye(4)
    scale = np.sqrt(np.diagonal(hessian, axis1=1, axis2=2))
    left = (damped @ step[..., None])[..., 0]
    np.testing.assert_allclose(left / scale, -gradient / scale, rtol=1e-9, atol=1e-9)


def test_a_parameter_nothing_depends_on_stays():
    hessian = np.array([[[4.0, 0.0], [0.0, 0.0]]])
    step = solve_damped(hessian, np.array([[2.0, 0.0]]), np.zeros(1))
    np.testing.assert_allclose(step, [[-0.5, 0.0]])


def test_rounded_residuals_do_not_stop_the_iteration():
    """Nearest points of a circle: small residuals as differences of large, rounded numbers."""
    rng = np.random.default_rng(42)
    angle = rng.uniform(0, 2 * np.pi, 400)
    target = 600 + (100 + rng.normal(size=(400, 1)) * 0.01) * np.stack(
        [np.cos(angle), np.sin(angle)], axis=-1
    )

    def circle(a, index):
        c, s = np.cos(a[:, 0]), np.sin(a[:, 0])
        residual = 600 + 100 * np.stack([c, s], axis=-1) - target[index]
        return residual, 100 * np.stack([-s, c], axis=-1)[..., None]

    solved = levenberg_marquardt(Curves(circle), ((angle + 0.2)[:, None],))
    assert solved.converged.all()
    np.testing.assert_allclose(solved.state[0][:, 0], angle, rtol=0, atol=STEP_TOLERANCE / 50)


def test_damping_falls_with_a_good_step_and_grows_ever_faster_with_bad_ones():
    """A step that gains what was predicted, half of it, and two that gain nothing."""
    damping, growth = update_damping(
        np.full(4, 1e-3),
        np.array([2.0, 8.0, 2.0, 8.0]),
        np.array([True, True, False, False]),
        gained=np.array([1.0, 0.5, -1.0, -1.0]),
        moved=np.ones(4),
    )
    np.testing.assert_allclose(damping, [1e-4, 1e-3, 2e-3, 8e-3])
    np.testing.assert_allclose(growth, [FIRST_GROWTH, FIRST_GROWTH, 4.0, 16.0])


def test_a_pivot_that_rounding_makes_zero_stops_no_other_system():
    """Two parameters alike but for rounding, beside a system without any fault."""
    alike = 1 + 5 * np.finfo(float).eps
    hessian = np.array([[[1.0, alike], [alike, 1.0]], [[2.0, 0.0], [0.0, 4.0]]])
    step = solve_damped(hessian, np.array([[1.0, 1.0], [2.0, 8.0]]), np.zeros(2))
    assert np.isfinite(step).all()
    assert step[1] == pytest.approx([-1.0, -2.0], rel=1e-12)
    equal = np.full((1, 2, 2), alike)
    assert np.trace(never_singular(np.linalg.inv, equal)[0]) > 1e13  # nothing that is determined
