"""One grasp and what was found out about it, as a file holds them: what words and pictures are made of."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..contacts import Grasp, component_names, contact_model
from ..core import Status, UserError, wrench_dimension

__all__ = ["ForceAnswer", "StoredGrasp", "Verdict"]

MAY_LACK = (
    "rank",
    "force",
    "twist",
    "bound_twist",
    "contact_force",
    "escape_twist",
    "load_twist",
)  # None: there is none


@dataclass(frozen=True)
class StoredGrasp:
    """One grasp, mesh frame: position and normal (k, d), friction, torsion and active (k,), centre_of_mass (d,).

    model  the contact model's name in ``contacts.MODELS``
    """

    position: np.ndarray
    normal: np.ndarray
    friction: np.ndarray
    torsion: np.ndarray
    active: np.ndarray
    centre_of_mass: np.ndarray
    model: str

    def __post_init__(self):
        """UserError where the parts do not fit each other: the row of a damaged file."""
        d, k = len(self.centre_of_mass), len(self.position)
        for name, shape in self._shapes(k, d, len(self.components)).items():
            value = getattr(self, name)
            if value is None and name in MAY_LACK:
                continue
            there = getattr(value, "shape", ())  # of a number: ()
            if value is None or there != shape:
                raise UserError(f"the row is damaged: {name} has the shape {there}, not {shape}")

    def _shapes(self, k: int, d: int, n: int) -> dict[str, tuple[int, ...]]:
        shapes: dict[str, tuple[int, ...]] = {"position": (k, d), "normal": (k, d)}
        return shapes | dict.fromkeys(("friction", "torsion", "active"), (k,))

    @property
    def size(self) -> float:
        """Largest distance of an active contact from the centre of mass, m; 1 where there is none or it is 0."""
        distance = np.linalg.norm(self.position - self.centre_of_mass, axis=1)[self.active]
        largest = float(distance.max(initial=0.0))
        return largest if np.isfinite(largest) and largest > 0 else 1.0

    @property
    def components(self) -> tuple[str, ...]:
        """Symbols of the force components of a contact, such as ("f_x", "f_y", "f_n")."""
        return component_names(self.model, len(self.centre_of_mass))

    def cone_use(self, contact: Any, force: np.ndarray) -> float:
        """``psi(f) / f_n`` of a force (n,): the share used of what friction allows; NaN where it does not press."""
        coefficient = {"f_x": self.friction, "f_y": self.friction, "tau_n": self.torsion}
        normal, square = 0.0, 0.0
        for name, value in zip(self.components, force, strict=True):
            if name == "f_n":
                normal = float(value)
            elif value != 0:
                limit = coefficient[name][contact]
                square += (value / limit) ** 2 if limit > 0 else np.inf
        return float(np.sqrt(square)) / normal if normal > 0 else float("nan")

    def grasp(self, dtype: np.dtype | type = np.float64) -> Grasp:
        """As it was solved: at the centre of mass, in ``dtype`` (enable 64-bit arrays first for float64)."""
        coefficients = self.friction.astype(dtype), self.torsion.astype(dtype)
        model = contact_model(self.model, *coefficients)
        position = (self.position - self.centre_of_mass).astype(dtype)
        return Grasp(position, self.normal.astype(dtype), model, self.active)


@dataclass(frozen=True)
class Verdict(StoredGrasp):
    """One grasp and its verdict, in space. Forces (k, n) or None; twists (6,) or None."""

    status: Status
    margin: float
    upper: float
    rank: int | None
    force: np.ndarray | None
    twist: np.ndarray | None
    bound_twist: np.ndarray | None = None

    def _shapes(self, k: int, d: int, n: int) -> dict[str, tuple[int, ...]]:
        own = {
            "centre_of_mass": (3,),
            "force": (k, n),
            "twist": (6,),
            "bound_twist": (6,),
            "margin": (),
            "upper": (),
            "rank": (),
        }
        return super()._shapes(k, 3, n) | own

    @classmethod
    def from_row(cls, row: dict[str, Any], metadata: dict[str, Any]) -> Verdict:
        """From what ``formats.parquet.read_row`` returns."""
        try:
            com, kind = np.asarray(metadata["centre_of_mass"], float), metadata["model"]["kind"]
            components = len(component_names(kind, 3))
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(
                "the file's metadata lack the centre of mass or the model; screen it again"
            ) from error
        try:
            status = Status(row["status"])
        except ValueError as error:
            raise UserError(f"the row's status, {row['status']}, is none that this jaxgrasp knows") from error

        def real(value: Any, *shape: int) -> Any:
            return None if value is None else np.asarray(value, float).reshape(shape or np.shape(value))

        try:
            position = real(row["position"], -1, 3)
            return cls(
                position=position,
                normal=real(row["normal"], -1, 3),
                friction=real(row["friction"]),
                torsion=real(row["torsion"]),
                active=np.asarray(row["active"], bool),
                centre_of_mass=com,
                model=kind,
                status=status,
                margin=float("nan") if row["margin"] is None else float(row["margin"]),
                upper=float("nan") if row["upper"] is None else float(row["upper"]),
                rank=None if row["rank"] is None else int(row["rank"]),
                force=real(row["internal_force"], len(position), components),
                twist=real(row["escape_twist"]),
                bound_twist=real(row.get("bound_twist")),
            )
        except UserError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"the row is damaged ({error})") from error


@dataclass(frozen=True)
class ForceAnswer(StoredGrasp):
    """One grasp, its load and the forces found, or why there are none. Forces (k, n) and (k, d), or None."""

    row: int
    grasp_id: int
    load: dict[str, Any]
    criterion: dict[str, Any]
    max_normal: float | None
    tolerance: float
    status: Status
    cost: float
    lower: float
    force: np.ndarray | None
    contact_force: np.ndarray | None
    escape_twist: np.ndarray | None
    load_twist: np.ndarray | None

    def _shapes(self, k: int, d: int, n: int) -> dict[str, tuple[int, ...]]:
        m = wrench_dimension(d)
        twists = dict.fromkeys(("escape_twist", "load_twist", "wrench"), (m,))
        return (
            super()._shapes(k, d, n)
            | twists
            | {"force": (k, n), "contact_force": (k, d), "cost": (), "lower": ()}
        )

    @classmethod
    def from_row(cls, row: dict[str, Any], metadata: dict[str, Any]) -> ForceAnswer:
        """From a row of a file of forces (``formats.force_table``) and the file's metadata."""
        try:
            k = len(row["position"])
            force = None if row["force"] is None else np.reshape(row["force"], (k, -1))
            com, kind = np.asarray(metadata["centre_of_mass"], float), metadata["model"]["kind"]
            component_names(kind, len(com))  # KeyError for a model that we do not know
            names = ("contact_force", "escape_twist", "load_twist")
            said = ("load", "criterion", "max_normal", "tolerance")
            return cls(
                **{
                    name: np.asarray(row[name], float)
                    for name in ("position", "normal", "friction", "torsion")
                },
                active=np.asarray(row["active"], bool),
                centre_of_mass=com,
                model=kind,
                status=Status(row["status"]),
                force=force,
                **{name: None if row[name] is None else np.asarray(row[name], float) for name in names},
                **{name: int(row[name]) for name in ("row", "grasp_id")},
                **{name: float(row[name]) for name in ("cost", "lower")},
                **{name: metadata[name] for name in said},
            )
        except UserError:
            raise
        except (KeyError, TypeError, ValueError) as error:
            raise UserError(f"the file of forces is damaged or incomplete ({error})") from error

    @property
    def wrench(self) -> np.ndarray:
        """(m,) force in N and torque in N m about the centre of mass, mesh axes."""
        return np.asarray(self.load["wrench"], float)
