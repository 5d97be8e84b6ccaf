"""Arrow systems against the same systems written out in full."""

import numpy as np
import pytest

from fisheye_svp_ros.solve.least_squares import (
    arrow_covariance,
    arrow_information,
    arrow_of_views,
    arrow_step,
)

SYSTEMS, VIEWS, ROWS, BLOCK, SHARED = 3, 5, 20, 6, 4


@pytest.fixture
def rows():
    random = np.random.default_rng(5)
    shape = (SYSTEMS, VIEWS, ROWS)
    # Units as far apart as metres and pixels, so that the scaling is put to work.
    units = 10.0 ** np.arange(-3, SHARED - 3)
    return (
        random.normal(size=shape),
        random.normal(size=(*shape, BLOCK)) * 100.0,
        random.normal(size=(*shape, SHARED)) * units,
    )


def arrow_of(residual, block_jacobian, shared_jacobian):
    """Return costs (S,) and normal equations of whitened rows."""
    jacobian = np.concatenate([block_jacobian, shared_jacobian], axis=-1)
    transposed = np.swapaxes(jacobian, -1, -2)
    gradient = (transposed @ residual[..., None])[..., 0]
    cost = (residual**2).sum(axis=-1)
    return arrow_of_views(cost, transposed @ jacobian, gradient, block=BLOCK)


def in_full(block_jacobian, shared_jacobian, system):
    """Return the Jacobian (V * M, V * B + K) of one system."""
    views, rows, block = block_jacobian.shape[1:]
    full = np.zeros((views * rows, views * block + shared_jacobian.shape[-1]))
    for view in range(views):
        span = slice(view * rows, (view + 1) * rows)
        full[span, view * block : (view + 1) * block] = block_jacobian[system, view]
        full[span, views * block :] = shared_jacobian[system, view]
    return full


def test_step_equals_the_step_of_the_full_system(rows):
    residual, block, shared = rows
    damping = np.array([0.0, 1e-3, 10.0])
    cost, normal = arrow_of(residual, block, shared)
    (block_step, shared_step), moved = arrow_step(normal, damping)
    for s in range(SYSTEMS):
        jacobian = in_full(block, shared, s)
        hessian = jacobian.T @ jacobian
        damped = hessian + damping[s] * np.diag(np.diag(hessian))
        expected = -np.linalg.solve(damped, jacobian.T @ residual[s].ravel())
        step = np.concatenate([block_step[s].ravel(), shared_step[s]])
        np.testing.assert_allclose(step, expected, rtol=1e-9)
        assert moved[s] == pytest.approx(np.sum((jacobian @ expected) ** 2), rel=1e-9)
        assert cost[s] == pytest.approx(np.sum(residual[s] ** 2))


def test_covariance_and_information_are_those_of_the_full_system(rows):
    residual, block, shared = rows
    _, normal = arrow_of(residual, block, shared)
    (of_blocks, of_shared), information = arrow_covariance(normal), arrow_information(normal)
    for s in range(SYSTEMS):
        jacobian = in_full(block, shared, s)
        full = np.linalg.inv(jacobian.T @ jacobian)
        np.testing.assert_allclose(of_shared[s], full[-SHARED:, -SHARED:], rtol=1e-8)
        np.testing.assert_allclose(
            information[s] @ full[-SHARED:, -SHARED:], np.eye(SHARED), atol=1e-9
        )
        for view in range(VIEWS):
            span = slice(view * BLOCK, (view + 1) * BLOCK)
            np.testing.assert_allclose(of_blocks[s, view], full[span, span], rtol=1e-8, atol=1e-12)


def test_parameters_that_nothing_depends_on_stay(rows):
    residual, block, shared = (array.copy() for array in rows)
    residual[:, 2], block[:, 2], shared[:, 2] = 0, 0, 0
    shared[..., 1] = 0
    _, normal = arrow_of(residual, block, shared)
    (block_step, shared_step), moved = arrow_step(normal, np.zeros(SYSTEMS))
    assert np.all(block_step[:, 2] == 0)
    assert np.all(np.abs(shared_step[:, 1]) < 1e-12)
    assert np.all(np.isfinite(moved))
    assert np.all(np.abs(shared_step[:, [0, 2, 3]]) > 1e-6)


def test_a_shared_parameter_that_the_blocks_absorb_carries_no_information(rows):
    residual, block, shared = (array.copy() for array in rows)
    shared[..., 0] = block[..., 3]
    _, normal = arrow_of(residual, block, shared)
    eigenvalue = np.linalg.eigvalsh(arrow_information(normal))[:, 0]
    assert np.all(np.abs(eigenvalue) < 1e-9 * np.diagonal(normal[2], axis1=1, axis2=2)[:, 0])
    (block_step, shared_step), _ = arrow_step(normal, np.zeros(SYSTEMS))
    assert np.all(np.isfinite(block_step)) and np.all(np.isfinite(shared_step))
    _, covariance = arrow_covariance(normal)
    for s in range(SYSTEMS):
        known = in_full(block, shared[..., 1:], s)
        full = np.linalg.inv(known.T @ known)
        last = slice(1 - SHARED, None)
        np.testing.assert_allclose(covariance[s, 1:, 1:], full[last, last], rtol=1e-6)
        step = np.linalg.lstsq(known, -residual[s].ravel(), rcond=None)[0]
        np.testing.assert_allclose(shared_step[s, 1:], step[last], rtol=1e-6)


def test_systems_do_not_mix(rows):
    damping = np.full(SYSTEMS, 1e-3)
    together = arrow_step(arrow_of(*rows)[1], damping)
    for s in range(SYSTEMS):
        alone = arrow_step(arrow_of(*(array[s : s + 1] for array in rows))[1], damping[:1])
        for got, want in zip((*together[0], together[1]), (*alone[0], alone[1]), strict=True):
            np.testing.assert_allclose(got[s], want[0], rtol=1e-10)
