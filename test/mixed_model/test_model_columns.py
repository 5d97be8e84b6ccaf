"""Columns of a mixed model, and their products, against the same as whole matrices."""

import numpy as np
import pytest
from helpers.mixed_models import FIELD, GROUP, KINDS, PLACE, SHARED, SIDE, TURN

from fisheye_svp_ros.mixed_model import (
    combine_offsets,
    group_basis,
    multiply_rows,
    predict_rows,
    project_out,
)
from fisheye_svp_ros.mixed_model.model_columns import multiply_columns


def whole(model):
    """Return columns of groups (n, G B), of units, with a label or without, and shared ones."""
    z, _, _ = model.columns()
    own = len(model.random.group) * 2
    units = model.random.unit_label.size
    return z[:, :own], z[:, own : own + units], z[:, own + units :]


def test_shared_columns_and_fields_are_as_they_stand_in_rows(model):
    _, unit, shared = whole(model)
    np.testing.assert_allclose(model.random.unit_columns.toarray(), unit)
    np.testing.assert_allclose(model.random.shared_columns.toarray(), shared)


def test_products_are_those_of_whole_matrices(model):
    """By group, unit, shared, border; nothing of a unit's place that has no label."""
    products = multiply_columns(model.random, model.group_fixed, model.border)
    groups = len(model.random.group)
    own = np.concatenate([model.group_fixed, model.random.group], axis=-1)
    flat = model._spread(own)
    _, unit, shared = whole(model)
    unit = np.where(model.random.unit_label.ravel() < 0, 0.0, unit)
    size = len(model.random.unit_label), 2
    by_unit = unit.reshape(len(unit), *size)
    border = model.flat
    np.testing.assert_allclose(products.gg, np.swapaxes(own, -1, -2) @ own)
    np.testing.assert_allclose(
        products.uu, np.einsum('nua,nub->uab', by_unit, by_unit), atol=1e-12
    )
    np.testing.assert_allclose(products.ug, (unit.T @ flat).reshape(*size, groups, -1), atol=1e-12)
    np.testing.assert_allclose(products.ss, shared.T @ shared, atol=1e-12)
    np.testing.assert_allclose(
        products.sg, (shared.T @ flat).reshape(-1, groups, own.shape[-1]), atol=1e-12
    )
    np.testing.assert_allclose(products.us, (unit.T @ shared).reshape(*size, -1), atol=1e-12)
    np.testing.assert_allclose(products.gx, np.swapaxes(own, -1, -2) @ model.border)
    np.testing.assert_allclose(products.ux, (unit.T @ border).reshape(*size, -1), atol=1e-12)
    np.testing.assert_allclose(products.sx, shared.T @ border, atol=1e-12)
    np.testing.assert_allclose(products.xx, border.T @ border)


def test_rows_are_multiplied_and_predicted_as_by_whole_matrices(model):
    random, rng = model.random, np.random.default_rng(2)
    own = model._spread(np.concatenate([model.group_fixed, random.group], axis=-1))
    _, unit, shared = whole(model)
    rows = rng.normal(size=(*model.border.shape[:2], 2))
    flat = rows.reshape(-1, 2)
    by_group, by_unit, by_all = multiply_rows(random, model.group_fixed, rows)
    np.testing.assert_allclose(by_group.reshape(-1, 2), own.T @ flat, atol=1e-12)
    labeled = random.unit_label.ravel()[:, None] >= 0
    np.testing.assert_allclose(by_unit.reshape(-1, 2), labeled * (unit.T @ flat), atol=1e-12)
    np.testing.assert_allclose(by_all, shared.T @ flat, atol=1e-12)

    units = np.array([0, 1, 3, 5])
    g, u, s = (rng.normal(size=(*size, 2)) for size in (by_group.shape[:2], (4, 2), (5,)))
    offset = np.zeros((len(random.unit_label), 2, 2))
    offset[units] = u
    offset[random.unit_label < 0] = 0.0
    predicted = own @ g.reshape(-1, 2) + unit @ offset.reshape(-1, 2) + shared @ s
    found = predict_rows(random, model.group_fixed, g, u, s, units)
    np.testing.assert_allclose(found.reshape(-1, 2), predicted, atol=1e-12)
    fields = random.fields.toarray() @ s[3:]
    np.testing.assert_allclose(
        combine_offsets(random, u, s, units).reshape(-1, 2),
        offset.reshape(-1, 2) + fields,
        atol=1e-12,
    )


@pytest.mark.parametrize('absent', [(GROUP,), (SIDE,), (PLACE, SIDE), (SHARED,), (TURN, FIELD)])
def test_columns_of_some_components_are_those_and_no_others(model, absent):
    some = model.random.select(~np.isin(KINDS, absent))
    fewer = model.__class__(
        some, model.group_fixed, model.border, model.with_lam(*absent).lam, model.weight
    )
    np.testing.assert_allclose(
        fewer.covariance(), model.with_lam(*absent).covariance(), atol=1e-12
    )
    labels = {*some.group_label, *some.unit_label[some.unit_label >= 0], *some.shared_label}
    assert labels == set(KINDS) - set(absent)


def test_a_basis_is_orthonormal_and_spans_what_the_columns_do(model):
    """However small or alike columns are; of less than full rank some are zero."""
    columns = model.group_fixed * [1e-12, 1e9]
    columns[0, :, 1] = 3 * columns[0, :, 0]
    basis = group_basis(columns)
    ranks = [1, 2, 1, 2, 2, 2]
    for own, one, rank in zip(basis, columns, ranks, strict=True):
        gram = own.T @ own
        assert np.linalg.matrix_rank(gram) == rank == round(np.trace(gram))
        np.testing.assert_allclose(gram @ gram, gram, atol=1e-12)
        size = np.linalg.norm(one, axis=0)
        left = one - own @ (own.T @ one)
        assert (np.linalg.norm(left, axis=0) <= 1e-9 * size).all()


def test_what_groups_fit_themselves_is_projected_out(model):
    found = project_out(model.border, model.group_fixed)
    for left, rows, columns in zip(found, model.border, model.group_fixed, strict=True):
        fit = np.linalg.lstsq(columns, rows, rcond=1e-9)[0]
        np.testing.assert_allclose(left, rows - columns @ fit, atol=1e-10)
