"""The test files that also run on a second Python: ``-m interface``."""

# Where another JAX, NumPy, MuJoCo, PyArrow or Python would show first: run on a second Python (.ci/run).
INTERFACES = (
    "test_backend",
    "test_certificate",
    "test_cli",
    "test_dynamics",
    "test_forces",
    "test_grasp",
    "test_lmi",
    "test_meshes",
    "test_parquet",
    "test_resistance",
    "test_rooms",
    "test_simulation",
    "test_tracing",
)
