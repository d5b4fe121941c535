"""Ground floor: array vocabulary, tolerances by dtype, statuses, rigid-body geometry, errors. It knows no grasp."""

from .answer import Answer
from .arrays import Array, ArrayLike, Bool, Float, Index, Int, on_host, real_array, widened
from .broadcast import spread
from .errors import UserError
from .geometry import (
    applied,
    contact_frame,
    cross,
    cross_components,
    frame_components,
    normalize,
    normalize_components,
    safe_root,
    skew,
    wrench_dimension,
)
from .renamed import renamed
from .rotations import (
    identity_orientation,
    jacobian_product,
    jacobian_solve,
    orientation_matrix,
    rotate,
    rotate_wrench,
    rotation_between,
    turned,
)
from .select import first_of, part_of
from .status import Status
from .tolerances import (
    balance_tolerance,
    complementary_ratio,
    edge_tolerance,
    gap_floor,
    largest_response,
    pivot_tolerance,
    proven_limit,
    rank_tolerance,
    rounding_constant,
    stationary_tolerance,
    unit_roundoff,
    visibility_tolerance,
    widest_scaling,
)
from .version import __version__

__all__ = [
    "Answer",
    "Array",
    "ArrayLike",
    "Bool",
    "Float",
    "Index",
    "Int",
    "Status",
    "UserError",
    "__version__",
    "applied",
    "balance_tolerance",
    "complementary_ratio",
    "contact_frame",
    "cross",
    "cross_components",
    "edge_tolerance",
    "first_of",
    "frame_components",
    "gap_floor",
    "identity_orientation",
    "jacobian_product",
    "jacobian_solve",
    "largest_response",
    "normalize",
    "normalize_components",
    "on_host",
    "orientation_matrix",
    "part_of",
    "pivot_tolerance",
    "proven_limit",
    "rank_tolerance",
    "real_array",
    "renamed",
    "rotate",
    "rotate_wrench",
    "rotation_between",
    "rounding_constant",
    "safe_root",
    "skew",
    "spread",
    "stationary_tolerance",
    "turned",
    "unit_roundoff",
    "visibility_tolerance",
    "widened",
    "widest_scaling",
    "wrench_dimension",
]
