"""The statistics engine: y = X b + Z u + e with block structure.

In: y, fixed columns X, random columns Z (by group, by unit, shared; a component label each), all
whitened.  Out: variances (REML), log-likelihood, score tests of added columns, BLUPs and their
covariance, leave-one-group-out predictions.  It knows no camera, board, lens or pixel.

    model_columns  X and Z, and their products
    equations      Henderson's mixed-model equations, factored block by block
    solution       estimates and predictions, their covariance, groups left out one by one
    reml           variances by restricted maximum likelihood (average information)
    components     which variances the data call for, and their p-values
    score_tests    Rao's score test of added fixed columns, on one information matrix
"""

from fisheye_svp_ros.mixed_model.components import (
    component_p_values,
    component_traces,
    find_variances,
    is_called_for,
    score_components,
)
from fisheye_svp_ros.mixed_model.equations import (
    Equations,
    FactoredEquations,
    factor_equations,
    make_equations,
    solve_lower,
)
from fisheye_svp_ros.mixed_model.model_columns import (
    Components,
    RandomColumns,
    combine_offsets,
    multiply_rows,
    predict_rows,
)
from fisheye_svp_ros.mixed_model.reml import (
    LAMBDA_ABSENT,
    Variances,
    estimate_variances,
    initial_variances,
    no_variances,
    unit_labels,
)
from fisheye_svp_ros.mixed_model.score_tests import (
    IDENTIFIABLE,
    Score,
    eliminate,
    fit_out,
    group_basis,
    identifiable_basis,
    integrate_columns,
    pseudo_inverse,
    satterthwaite_freedom,
    score_columns,
    score_each,
)
from fisheye_svp_ros.mixed_model.solution import (
    LeaveOneOut,
    Posterior,
    Solution,
    leave_groups_out,
    posterior_covariance,
    posterior_variances,
    solve_equations,
    unit_covariances,
)

__all__ = [
    'IDENTIFIABLE', 'LAMBDA_ABSENT', 'Components', 'Equations', 'FactoredEquations', 'LeaveOneOut',
    'Posterior', 'RandomColumns', 'Score', 'Solution', 'Variances', 'combine_offsets',
    'component_p_values', 'component_traces', 'eliminate', 'estimate_variances',
    'factor_equations', 'find_variances', 'fit_out', 'group_basis', 'identifiable_basis',
    'initial_variances', 'integrate_columns', 'is_called_for', 'leave_groups_out',
    'make_equations', 'multiply_rows', 'no_variances', 'posterior_covariance',
    'posterior_variances', 'predict_rows', 'pseudo_inverse', 'satterthwaite_freedom',
    'score_columns', 'score_components', 'score_each', 'solve_equations', 'solve_lower',
    'unit_covariances', 'unit_labels',
]
