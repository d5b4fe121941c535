"""Grasp sets in and out, one file a format."""

from .force_table import Forces, GraspFile, as_row, force_schema, force_table, read_force_row
from .grasp_npz import load_grasp, save_grasp
from .parquet import ContactFile, Contacts, Verdicts, dump, read_metadata, read_row, schema, table, write
from .saved_grasp import SavedGrasps

__all__ = [
    "ContactFile",
    "Contacts",
    "Forces",
    "GraspFile",
    "SavedGrasps",
    "Verdicts",
    "as_row",
    "dump",
    "force_schema",
    "force_table",
    "load_grasp",
    "read_force_row",
    "read_metadata",
    "read_row",
    "save_grasp",
    "schema",
    "table",
    "write",
]
