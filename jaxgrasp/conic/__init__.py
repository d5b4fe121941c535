"""Second-order cone programs, thousands at a time: cones, linear algebra, interior-point methods, derivatives.

It has never heard of grasping: it knows cones, a few dense equality constraints, and lanes.
"""

from .cone import Cone, cone_max, cone_min, cone_sum, determinant, inner, interior_distance, tail_norm
from .cone_program import ConeProgram
from .convex_interior_point import State, begin_convex_program, solve_convex_program
from .convex_program import Bounds, ConvexProgram, Curvature, Point, as_vector
from .derivatives import Shift, centring, lagrangian, point_tangent, residuals
from .interior_point import Iterate, Progress, Step, advance, begin_cone_program, solve_cone_program
from .linear import (
    Cholesky,
    Vector,
    inverse_frobenius,
    matvec,
    null_combination,
    orthonormal_rows,
    rmatvec,
    solve_lower,
    solve_transposed,
    vector_norm,
)
from .reduced_newton import Motion, newton_solve
from .regularity import regular
from .singular_values import row_svd

__all__ = [
    "Bounds",
    "Cholesky",
    "Cone",
    "ConeProgram",
    "ConvexProgram",
    "Curvature",
    "Iterate",
    "Motion",
    "Point",
    "Progress",
    "Shift",
    "State",
    "Step",
    "Vector",
    "advance",
    "as_vector",
    "begin_cone_program",
    "begin_convex_program",
    "centring",
    "cone_max",
    "cone_min",
    "cone_sum",
    "determinant",
    "inner",
    "interior_distance",
    "inverse_frobenius",
    "lagrangian",
    "matvec",
    "newton_solve",
    "null_combination",
    "orthonormal_rows",
    "point_tangent",
    "regular",
    "residuals",
    "rmatvec",
    "row_svd",
    "solve_cone_program",
    "solve_convex_program",
    "solve_lower",
    "solve_transposed",
    "tail_norm",
    "vector_norm",
]
