"""The statistics engine: y = X b + Z u + e with block structure.

In: y, fixed columns X, random columns Z (by group, by unit, shared; a component label each), all
whitened.  Out: variances (REML), log-likelihood, score tests of added columns, BLUPs and their
covariance, leave-one-group-out predictions.  It knows no camera, board, lens or pixel.

    model_columns  X and Z, and their products
    equations      Henderson's mixed-model equations, factored block by block
    solution       estimates and predictions, their covariance, groups left out one by one
    reml           variances by restricted maximum likelihood, which the data call for, p-values
    model_averaging  which added columns are there: all likely subsets, their coefficients
    score_tests    Rao's score tests of added fixed columns and of variances at zero
    threads        work on all cores
"""

from fisheye_svp_ros.mixed_model.equations import (
    LAMBDA_ABSENT,
    Equations,
    FactoredEquations,
    Variances,
    factor_equations,
    make_equations,
    no_variances,
    solve_lower,
)
from fisheye_svp_ros.mixed_model.model_averaging import (
    Coefficients,
    Estimates,
    Models,
    Options,
    Products,
    estimate_models,
    find_coefficients,
    find_models,
    log_evidence,
)
from fisheye_svp_ros.mixed_model.model_columns import (
    Components,
    RandomColumns,
    combine_offsets,
    group_basis,
    multiply_rows,
    predict_rows,
    project_out,
)
from fisheye_svp_ros.mixed_model.reml import (
    component_p_values,
    estimate_variances,
    find_variances,
    initial_variances,
    is_called_for,
    remove_contradicted,
    unit_labels,
)
from fisheye_svp_ros.mixed_model.score_tests import (
    IDENTIFIABLE,
    Score,
    component_squares,
    eliminate,
    identifiable_basis,
    integrate_columns,
    pseudo_inverse,
    satterthwaite_freedom,
    score_columns,
    score_components,
    score_each,
    subtract_fit,
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
from fisheye_svp_ros.mixed_model.threads import map_in_threads, run_in_threads

__all__ = [
    'IDENTIFIABLE',
    'LAMBDA_ABSENT',
    'Coefficients',
    'Components',
    'Equations',
    'Estimates',
    'FactoredEquations',
    'LeaveOneOut',
    'Models',
    'Options',
    'Posterior',
    'Products',
    'RandomColumns',
    'Score',
    'Solution',
    'Variances',
    'combine_offsets',
    'component_p_values',
    'component_squares',
    'eliminate',
    'estimate_models',
    'estimate_variances',
    'factor_equations',
    'find_coefficients',
    'find_models',
    'find_variances',
    'group_basis',
    'identifiable_basis',
    'initial_variances',
    'integrate_columns',
    'is_called_for',
    'leave_groups_out',
    'log_evidence',
    'make_equations',
    'map_in_threads',
    'multiply_rows',
    'no_variances',
    'posterior_covariance',
    'posterior_variances',
    'predict_rows',
    'project_out',
    'pseudo_inverse',
    'remove_contradicted',
    'run_in_threads',
    'satterthwaite_freedom',
    'score_columns',
    'score_components',
    'score_each',
    'solve_equations',
    'solve_lower',
    'subtract_fit',
    'unit_covariances',
    'unit_labels',
]
