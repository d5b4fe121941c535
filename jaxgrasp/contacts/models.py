"""Contact models: objects that answer questions about the forces a contact can transmit.

Every model is one unit second-order cone after scaling (mu and gamma fold into the grasp map's columns),

    psi(f) = |(f_x / mu, f_y / mu, tau_n / gamma)| <= f_n,

so frictionless, hard and soft contacts may share one grasp: a soft finger with gamma = 0 is a hard one, with
mu = gamma = 0 a frictionless one. Forces are in N, torques in N m, mu has no unit, gamma is a length in m.
"""

from __future__ import annotations

from abc import abstractmethod
from enum import Enum

import equinox as eqx
import jax.numpy as jnp

from ..core import Array, ArrayLike, Float, real_array, safe_root, uniform

__all__ = [
    "Component",
    "ContactModel",
    "Frictionless",
    "HardFinger",
    "MODELS",
    "SoftFinger",
    "component_names",
    "contact_model",
    "model_name",
]


class Component(Enum):
    """One coordinate of a contact force."""

    TANGENT_1 = "f_x"
    TANGENT_2 = "f_y"
    NORMAL = "f_n"
    SPIN = "tau_n"


class ContactModel(eqx.Module):
    """The questions a contact answers. Subclasses state components and coefficients; the rest follows."""

    @abstractmethod
    def components(self, dimension: int) -> tuple[Component, ...]:
        """Force components in the chapter's order, for a body in ``dimension`` 2 or 3."""

    @property
    @abstractmethod
    def friction_coefficient(self) -> Float[Array, "*contacts"]:
        """``mu`` of (11.3), per contact."""

    @property
    @abstractmethod
    def torsion_coefficient(self) -> Float[Array, "*contacts"]:
        """``gamma`` of (11.34) in m, per contact."""

    @abstractmethod
    def with_coefficients(
        self, friction: Float[Array, "*contacts"], torsion: Float[Array, "*contacts"]
    ) -> ContactModel:
        """The same model with other coefficients."""

    @abstractmethod
    def lmi_matrices(self, dimension: int) -> Float[Array, "*contacts n q q"]:
        """The S_j of ``P(f) = sum_j f_j S_j >= 0`` (11.9), one stack per contact."""

    @abstractmethod
    def log_det_terms(
        self, dimension: int
    ) -> tuple[Float[Array, "*contacts"], Float[Array, "*contacts"], Float[Array, "*contacts"]]:
        """(a, b, c), per contact, of ``log det P(f) = a log f_n + b log(f_n^2 - psi^2) + c`` for (11.4), (11.35).

        Wherever mu = 0, P is the scalar f_n: a = 1, b = c = 0.
        """

    def force_size(self, dimension: int) -> int:
        """n, the number of force components of one contact."""
        return len(self.components(dimension))

    def normal_index(self, dimension: int) -> int:
        """Position of f_n among the components."""
        return self.components(dimension).index(Component.NORMAL)

    @eqx.filter_jit
    def scaling(self, dimension: int) -> Float[Array, "*contacts n"]:
        """``(mu, mu, 1, gamma)`` in the order of the components: f_j = scaling_j s_j, s in the unit cone."""
        mu, gamma = self.friction_coefficient, self.torsion_coefficient
        by_component = {
            Component.TANGENT_1: mu,
            Component.TANGENT_2: mu,
            Component.NORMAL: jnp.ones_like(mu),
            Component.SPIN: gamma,
        }
        return jnp.stack([by_component[c] for c in self.components(dimension)], axis=-1)

    @eqx.filter_jit
    def friction_function(
        self, force: Float[Array, "*contacts n"], dimension: int
    ) -> Float[Array, "*contacts"]:
        """``psi(f) = |(f_x / mu, f_y / mu, tau_n / gamma)|`` in N; the force is feasible iff psi(f) <= f_n.

        Infinite where a component is not zero but its coefficient is.
        """
        scale = self.scaling(dimension)
        ratio = jnp.where(force == 0, 0.0, force / jnp.where(scale > 0, scale, 1.0))
        ratio = jnp.where((scale <= 0) & (force != 0), jnp.inf, ratio)
        tangential = jnp.delete(ratio, self.normal_index(dimension), axis=-1)
        return safe_root(jnp.sum(tangential * tangential, axis=-1))

    @eqx.filter_jit
    def feasibility_slack(
        self, force: Float[Array, "*contacts n"], dimension: int
    ) -> Float[Array, "*contacts"]:
        """``f_n - psi(f)`` in N: positive inside the friction cone."""
        return force[..., self.normal_index(dimension)] - self.friction_function(force, dimension)

    @eqx.filter_jit
    def dual_slack(self, velocity: Float[Array, "*contacts n"], dimension: int) -> Float[Array, "*contacts"]:
        """``x_n - |(mu x_x, mu x_y, gamma x_tau)|``: at least 0 iff no feasible force does negative work.

        ``velocity`` is ``G_i^T xi``, the contact's velocity in its own frame (m/s, rad/s).
        """
        scaled = velocity * self.scaling(dimension)
        tangential = jnp.delete(scaled, self.normal_index(dimension), axis=-1)
        normal = velocity[..., self.normal_index(dimension)]
        return normal - safe_root(jnp.sum(tangential * tangential, axis=-1))


def _symmetric_unit(size: int, row: int, column: int, dtype) -> Array:
    unit = jnp.zeros((size, size), dtype).at[row, column].set(1.0)
    return unit.at[column, row].set(1.0)


def _arrow_matrices(
    coefficients: list[Array], diagonal: Array, normal_index: int
) -> Float[Array, "*contacts n q q"]:
    """S_j of the arrow matrix ``diagonal * f_n I + sum_j coefficient_j f_j (e_j e_q^T + e_q e_j^T)``."""
    size = len(coefficients) + 1
    matrices = [
        c[..., None, None] * _symmetric_unit(size, j, size - 1, c.dtype) for j, c in enumerate(coefficients)
    ]
    matrices.insert(normal_index, diagonal[..., None, None] * jnp.eye(size, dtype=diagonal.dtype))
    return jnp.stack(matrices, axis=-3)


def _where_rough(friction: Array, value: float, otherwise: float) -> Array:
    return jnp.where(friction > 0, jnp.full_like(friction, value), jnp.full_like(friction, otherwise))


class Frictionless(ContactModel):
    """Frictionless point contact: ``f = (f_n)``, ``f_n >= 0``, ``P(f) = f_n``."""

    zero: Float[Array, "*contacts"]

    def __init__(self, zero: Float[ArrayLike, "*contacts"] = 0.0):  # zeros in the shape of the contacts
        self.zero = real_array(zero, "the placeholder")

    def components(self, dimension: int) -> tuple[Component, ...]:
        """``(f_n)``."""
        return (Component.NORMAL,)

    @property
    def friction_coefficient(self) -> Float[Array, "*contacts"]:
        """``mu = 0``, no unit."""
        return uniform(self.zero.shape, 0.0, self.zero.dtype)

    @property
    def torsion_coefficient(self) -> Float[Array, "*contacts"]:
        """``gamma = 0``, m."""
        return uniform(self.zero.shape, 0.0, self.zero.dtype)

    def with_coefficients(
        self, friction: Float[Array, "*contacts"], torsion: Float[Array, "*contacts"]
    ) -> Frictionless:
        """A frictionless model in the shape of ``friction``; both coefficients stay 0."""
        return Frictionless(uniform(friction.shape, 0.0, friction.dtype))

    @eqx.filter_jit
    def lmi_matrices(self, dimension: int) -> Float[Array, "*contacts 1 1 1"]:
        """``S = [[1]]``: P(f) = f_n."""
        return jnp.ones((*self.zero.shape, 1, 1, 1), self.zero.dtype)

    @eqx.filter_jit
    def log_det_terms(
        self, dimension: int
    ) -> tuple[Float[Array, "*contacts"], Float[Array, "*contacts"], Float[Array, "*contacts"]]:
        """``log f_n``: (1, 0, 0)."""
        one, zero = (uniform(self.zero.shape, x, self.zero.dtype) for x in (1.0, 0.0))
        return one, zero, zero


class HardFinger(ContactModel):
    """Hard point contact with Coulomb friction (11.3): ``|(f_x, f_y)| <= mu f_n``.

    ``friction`` is mu >= 0: a number, or one per contact. In the plane the force is ``(f_t, f_n)``.
    """

    friction: Float[Array, "*contacts"]

    def __init__(self, friction: Float[ArrayLike, "*contacts"] = 0.5):
        self.friction = real_array(friction, "friction")

    def components(self, dimension: int) -> tuple[Component, ...]:
        """``(f_x, f_y, f_n)``, in the plane ``(f_t, f_n)``."""
        if dimension == 2:
            return (Component.TANGENT_1, Component.NORMAL)
        return (Component.TANGENT_1, Component.TANGENT_2, Component.NORMAL)

    @property
    def friction_coefficient(self) -> Float[Array, "*contacts"]:
        """``mu`` of (11.3), no unit."""
        return self.friction

    @property
    def torsion_coefficient(self) -> Float[Array, "*contacts"]:
        """``gamma = 0``, m."""
        return uniform(self.friction.shape, 0.0, self.friction.dtype)

    def with_coefficients(
        self, friction: Float[Array, "*contacts"], torsion: Float[Array, "*contacts"]
    ) -> HardFinger:
        """Hard fingers with mu = ``friction``; gamma stays 0."""
        return HardFinger(friction)

    @eqx.filter_jit
    def lmi_matrices(self, dimension: int) -> Float[Array, "*contacts n q q"]:
        """(11.4): ``[[mu f_n, 0, f_x], [0, mu f_n, f_y], [f_x, f_y, mu f_n]]``; its 2 x 2 form in the plane.

        lambda_min = mu (f_n - psi). Where mu = 0 there is no tangential force and P = f_n I.
        """
        mu = self.friction
        tangent = jnp.where(mu > 0, jnp.ones_like(mu), jnp.zeros_like(mu))
        diagonal = jnp.where(mu > 0, mu, jnp.ones_like(mu))
        return _arrow_matrices([tangent] * (dimension - 1), diagonal, self.normal_index(dimension))

    @eqx.filter_jit
    def log_det_terms(
        self, dimension: int
    ) -> tuple[Float[Array, "*contacts"], Float[Array, "*contacts"], Float[Array, "*contacts"]]:
        """``dimension log mu + (dimension - 2) log f_n + log(f_n^2 - psi^2)``."""
        mu = self.friction
        safe = jnp.where(mu > 0, mu, jnp.ones_like(mu))
        return _where_rough(mu, dimension - 2, 1), _where_rough(mu, 1, 0), dimension * jnp.log(safe)


class SoftFinger(ContactModel):
    """Soft finger, elliptic model (11.34): ``(f_x^2 + f_y^2) / mu^2 + tau_n^2 / gamma^2 <= f_n^2``.

    ``friction`` is mu >= 0, ``torsion`` is gamma >= 0 in m (the largest torque is gamma f_n); numbers, or one
    per contact. A planar soft finger does not exist.
    """

    friction: Float[Array, "*contacts"]
    torsion: Float[Array, "*contacts"]

    def __init__(
        self, friction: Float[ArrayLike, "*contacts"] = 0.5, torsion: Float[ArrayLike, "*contacts"] = 0.01
    ):
        self.friction = real_array(friction, "friction")
        self.torsion = real_array(torsion, "torsion")

    def components(self, dimension: int) -> tuple[Component, ...]:
        """``(f_x, f_y, f_n, tau_n)``; ValueError in the plane."""
        if dimension == 2:
            raise ValueError(
                "a planar soft finger does not exist: torsion acts about the normal, which lies in the "
                "plane. Use HardFinger for planar grasps, or 3-D positions."
            )
        return (Component.TANGENT_1, Component.TANGENT_2, Component.NORMAL, Component.SPIN)

    @property
    def friction_coefficient(self) -> Float[Array, "*contacts"]:
        """``mu`` of (11.3), no unit."""
        return self.friction

    @property
    def torsion_coefficient(self) -> Float[Array, "*contacts"]:
        """``gamma`` of (11.34), m."""
        return self.torsion

    def with_coefficients(
        self, friction: Float[Array, "*contacts"], torsion: Float[Array, "*contacts"]
    ) -> SoftFinger:
        """Soft fingers with mu = ``friction`` and gamma = ``torsion`` in m."""
        return SoftFinger(friction, torsion)

    @eqx.filter_jit
    def lmi_matrices(self, dimension: int) -> Float[Array, "*contacts 4 4 4"]:
        """(11.35): ``f_n I`` with ``f_x / mu, f_y / mu, tau_n / gamma`` in the last row and column.

        lambda_min = f_n - psi. A component whose coefficient is 0 does not exist; its S_j is 0.
        """
        inverses = [
            jnp.where(c > 0, 1 / jnp.where(c > 0, c, 1.0), 0.0)
            for c in (self.friction, self.friction, self.torsion)
        ]
        return _arrow_matrices(inverses, jnp.ones_like(self.friction), self.normal_index(dimension))

    @eqx.filter_jit
    def log_det_terms(
        self, dimension: int
    ) -> tuple[Float[Array, "*contacts"], Float[Array, "*contacts"], Float[Array, "*contacts"]]:
        """``2 log f_n + log(f_n^2 - psi^2)``."""
        mu = self.friction
        return _where_rough(mu, 2, 1), _where_rough(mu, 1, 0), jnp.zeros_like(mu)


# What files and the command line call them.
MODELS: dict[str, type[ContactModel]] = {"hard": HardFinger, "soft": SoftFinger, "frictionless": Frictionless}


def contact_model(
    name: str, friction: Float[ArrayLike, "*batch"], torsion: Float[ArrayLike, "*batch"]
) -> ContactModel:
    """The model of this name in ``MODELS`` with mu and gamma (m) per contact; those it does not have are left out."""
    return MODELS[name]().with_coefficients(real_array(friction, "friction"), real_array(torsion, "torsion"))


def model_name(model: ContactModel) -> str:
    """The name of ``model`` in ``MODELS``; ValueError for a model that has none."""
    for name, kind in MODELS.items():
        if type(model) is kind:
            return name
    known = ", ".join(sorted(kind.__name__ for kind in MODELS.values()))
    raise ValueError(f"the contact model {type(model).__name__} has no name; known models: {known}")


def component_names(name: str, dimension: int) -> tuple[str, ...]:
    """The symbols of the force components of the model of this name, such as ("f_x", "f_y", "f_n")."""
    return tuple(component.value for component in MODELS[name]().components(dimension))
