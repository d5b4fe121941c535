"""Grasp sets in and out, one file a format: our Parquet tables of verdicts, forces and checks, contacts, one grasp."""

from .check_table import check_schema, check_table, read_check_columns
from .contact_file import ContactFile, GraspFile
from .force_table import Forces, force_schema, force_table, read_force_row
from .metadata import METADATA_KEY, dump_metadata
from .npz import SavedGrasps, load_grasp, save_grasp
from .parquet import (
    MOST_BYTES,
    Contacts,
    Verdicts,
    as_row,
    damage_told,
    read_metadata,
    read_row,
    verdict_schema,
    verdict_table,
    write,
)
from .stored_verdicts import StoredVerdicts

__all__ = [
    "METADATA_KEY",
    "MOST_BYTES",
    "ContactFile",
    "Contacts",
    "Forces",
    "GraspFile",
    "SavedGrasps",
    "StoredVerdicts",
    "Verdicts",
    "as_row",
    "check_schema",
    "check_table",
    "damage_told",
    "dump_metadata",
    "force_schema",
    "force_table",
    "load_grasp",
    "read_check_columns",
    "read_force_row",
    "read_metadata",
    "read_row",
    "save_grasp",
    "verdict_schema",
    "verdict_table",
    "write",
]
