"""One grasp's controllability in words: the verdict, its reason, and the motion that forces do not reach."""

from __future__ import annotations

import numpy as np

from ..core import Status
from ..motion import Controllability, Linearization
from .words import motion_words

__all__ = ["explain_controllability"]

V = Status


def explain_controllability(
    found: Controllability, lane: int | tuple[int, ...] = (), centre_of_mass=None, size: float | None = None
) -> str:
    """The verdict of lane ``lane`` of ``found``, why, and the motion that is out of reach, or hardest to reach.

    centre_of_mass  (d,) m, in whose axes points are told; default the origin
    size            m, what counts as far from the centre of mass; default 5 cm
    """
    m = found.singular_values.shape[-1]
    d = 3 if m == 6 else 2
    com = np.zeros(d) if centre_of_mass is None else np.asarray(centre_of_mass, float)

    def at(name: str) -> np.ndarray:
        return np.asarray(getattr(found, name))[lane]

    verdict, point = V(int(at("status"))), V(int(at("equilibrium")))
    lines = [found.sentence(lane)]
    if verdict is V.INVALID:
        return lines[0]
    if verdict in (V.NO_EQUILIBRIUM, V.MARGINAL, V.UNDECIDED):
        lines.append(Linearization.SENTENCES.get(point, point.sentence))
    rank, reduced, alone = (int(at(name)) for name in ("rank", "reduced_rank", "grasp_rank"))
    lines.append(
        f"The fingers alone reach {alone} of {m} directions, with gravity {reduced}; the controllability matrix has "
        f"rank {rank} of {2 * m}."
    )
    size = 0.05 if size is None else size
    if reduced < m:
        motion = motion_words(at("uncontrollable"), com, size, distance=False)
        left = m - reduced
        many = "" if left == 1 else f" (one of {left} independent ones)"
        lines.append(f"Out of reach{many}: {motion}.")
    elif verdict is not V.NO_EQUILIBRIUM:
        lines.append(
            f"The state hardest to reach takes {float(at('effort')):.3g} times the weight, root mean square of all "
            "contact forces in units of their friction cones, for one radius of gyration in the time sqrt(l / g)."
        )
    if verdict is V.CONTROLLABLE and V(int(at("resistance"))) is V.MARGINAL:
        lines.append("Its margin of wrench resistance is zero.")
    return "\n".join(lines)
