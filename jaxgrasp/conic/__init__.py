"""Second-order cone programs, thousands at a time: cones, linear algebra, interior-point methods, derivatives.

It has never heard of grasping: it knows cones, a few dense equality constraints, and lanes.
"""

from .cholesky import (
    Cholesky,
    inverse_frobenius,
    null_combination,
    residual_lower,
    solve_lower,
    solve_transposed,
)
from .cone import (
    Cone,
    cone_all,
    cone_any,
    cone_max,
    cone_min,
    cone_sum,
    determinant,
    entries,
    inner,
    interior_distance,
    tail_norm,
)
from .convex_cone_program import Bounds, ConvexConeProgram, ConvexPoint, Curvature
from .convex_interior_point import ConvexState, begin_convex_cone_program, solve_convex_cone_program
from .derivatives import PointShift, centring, lagrangian, point_tangent, residuals
from .gram_schmidt import orthonormal_rows
from .linear_cone_program import LinearConeProgram
from .linear_interior_point import (
    LinearState,
    advance_linear_cone_program,
    begin_linear_cone_program,
    solve_linear_cone_program,
)
from .linear_newton_step import LinearPoint, LinearStep
from .pairs import Pair, pair, pair_roundoff, pair_sqrt, pair_sum, pair_where
from .products import matvec, rmatvec, vector_inner, vector_norm
from .reduced_kkt import KKTVector, kkt_solve
from .regularity import regular
from .singular_values import RowSVD, row_svd
from .small_matrices import eigenvalues, left_svd, null_basis, pseudo_inverse, singular_values, solve

__all__ = [
    "Bounds",
    "Cholesky",
    "Cone",
    "ConvexConeProgram",
    "ConvexPoint",
    "ConvexState",
    "Curvature",
    "KKTVector",
    "LinearConeProgram",
    "LinearPoint",
    "LinearState",
    "LinearStep",
    "Pair",
    "PointShift",
    "RowSVD",
    "advance_linear_cone_program",
    "begin_convex_cone_program",
    "begin_linear_cone_program",
    "centring",
    "cone_all",
    "cone_any",
    "cone_max",
    "cone_min",
    "cone_sum",
    "determinant",
    "eigenvalues",
    "entries",
    "inner",
    "interior_distance",
    "inverse_frobenius",
    "kkt_solve",
    "lagrangian",
    "left_svd",
    "matvec",
    "null_basis",
    "null_combination",
    "orthonormal_rows",
    "pair",
    "pair_roundoff",
    "pair_sqrt",
    "pair_sum",
    "pair_where",
    "point_tangent",
    "pseudo_inverse",
    "regular",
    "residual_lower",
    "residuals",
    "rmatvec",
    "row_svd",
    "singular_values",
    "solve",
    "solve_convex_cone_program",
    "solve_linear_cone_program",
    "solve_lower",
    "solve_transposed",
    "tail_norm",
    "vector_inner",
    "vector_norm",
]
