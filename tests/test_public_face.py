"""The public face: documented, annotated with shapes, subject first and the rest by name; one answer, one status."""

import dataclasses
import importlib
import inspect
import re
from enum import Enum

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shapes import HARD, PLANAR, SOFT

import jaxgrasp as jg
from jaxgrasp import Status, lmi
from jaxgrasp.core.renamed import _NEW_PLACES

ROOMS = ("contacts", "resistance", "forces", "quality", "motion", "lmi", "objects", "surfaces", "placement")

# Files of the rooms above whose functions are parts of compiled kernels: shared between rooms, of no use to a caller.
KERNELS = (
    "jaxgrasp.conic.", "jaxgrasp.contacts.folded", "jaxgrasp.contacts.projection", "jaxgrasp.contacts.validity",
    "jaxgrasp.contacts.tiled_derivatives", "jaxgrasp.resistance.problem", "jaxgrasp.resistance.verdict",
    "jaxgrasp.resistance.derivatives", "jaxgrasp.quality.unit_wrench_space", "jaxgrasp.quality.boundary_along",
)  # fmt: skip

# Arguments that may go without their name: subjects, the letters of a formula on the same line, indices.
SUBJECTS = {
    "answer", "body", "component", "constant", "count", "direction", "displacement", "dimension",
    "factor", "factors", "force", "friction", "grasp", "index", "keep", "matrices", "memory", "mesh",
    "model", "name", "normal", "option", "orientation", "path", "point", "position", "problem", "rate",
    "seed", "source", "state", "surface", "times", "torsion", "uniform", "value", "velocity", "wrench",
    "wrenches", "A", "B", "V", "b", "batch", "c", "d", "tolerance", "u", "x",
}  # fmt: skip
# (timestep, dimension) of a controller's check, as the closed loop asks it.
ASKED_BY_THE_LOOP = {"timestep"}

# The certificates import NumPy alone, so ``check`` cannot name the classes of what it checks.
WITHOUT_CLASSES = {"check", "prove"}

ANSWERS = {
    "wrench_resistance": "WrenchResistance",
    "optimize_forces": "OptimalForces",
    "equilibrium": "forces.Equilibrium",
    "squeeze": "forces.Squeeze",
    "resistible_wrenches": "forces.ResistibleWrenches",
    "epsilon_quality": "quality.EpsilonQuality",
    "critical_friction": "quality.CriticalFriction",
    "guaranteed_radius": "quality.GuaranteedRadius",
    "task_quality": "quality.TaskQuality",
    "quality.friction_sweep": "WrenchResistance",
    "linearize": "motion.Linearization",
    "controllability": "motion.Controllability",
    "close_loop": "motion.ClosedLoop",
    "lmi.lmi_minimize": "lmi.LMISolution",
    "lmi.lmi_feasibility": "lmi.LMIFeasibility",
    "lmi.sdp_minimize": "lmi.SDPSolution",
    "lmi.lmi_forces": "lmi.LMIForces",
}


def found(path):
    """What ``jaxgrasp.path`` names."""
    value = jg
    for part in path.split("."):
        value = getattr(value, part)
    return value


def public():
    """(name, object) of all that the package and its rooms offer, each once."""
    seen, out = set(), []
    for prefix, module in [("", jg), *((f"{r}.", importlib.import_module(f"jaxgrasp.{r}")) for r in ROOMS)]:
        for name in module.__all__:
            value = getattr(module, name)
            ours = getattr(value, "__module__", "") or ""
            if id(value) in seen or not ours.startswith("jaxgrasp") or not callable(value):
                continue
            seen.add(id(value))
            out.append((prefix + name, value))
    return out


def functions():
    """(name, function) of all public functions, methods and properties; a class's constructor is not one."""
    for name, value in public():
        if not inspect.isclass(value):
            yield name, inspect.unwrap(value)
            continue
        for key, member in vars(value).items():
            if key.startswith("_") and key != "__getitem__":
                continue
            member = member.fget if isinstance(member, property) else getattr(member, "__func__", member)
            member = inspect.unwrap(member) if callable(member) else member
            if inspect.isfunction(member) and member.__module__.startswith("jaxgrasp"):
                yield f"{name}.{key}", member


PUBLIC = [pytest.param(value, id=name) for name, value in public()]
FUNCTIONS = list(functions())
FOR_PEOPLE = [(n, f) for n, f in FUNCTIONS if not f.__module__.startswith(KERNELS)]


def begins_well(text):
    """A formula in quotes, or a sentence: a capital, a number or a symbol of the chapter first, a full stop last."""
    first = text.strip().split("\n\n")[0].rstrip()
    starts = re.match(r"``|[A-Z0-9(|+-]|[a-z](\W|_)", first)
    return bool(starts) and (first.startswith("``") or first[-1] in ".:")


def test_everything_public_is_documented():
    silent = [
        name for name, value in public() if inspect.isclass(value) and not value.__dict__.get("__doc__")
    ]
    silent += [name for name, function in FUNCTIONS if not function.__doc__]
    assert not silent
    odd = [n for n, f in FUNCTIONS if not begins_well(f.__doc__)]
    odd += [n for n, value in public() if inspect.isclass(value) and not begins_well(value.__doc__)]
    assert not odd


def annotations():
    """(name, argument, annotation) of all signatures and fields for people; constructors included."""
    for name, function in FOR_PEOPLE:
        if name in WITHOUT_CLASSES:
            continue
        signature = inspect.signature(function)
        for argument in signature.parameters.values():
            if argument.name not in ("self", "cls"):
                yield name, argument.name, argument.annotation
        yield name, "return", signature.return_annotation
    for name, value in public():
        if not inspect.isclass(value) or issubclass(value, Enum) or value.__module__.startswith(KERNELS):
            continue
        for field, annotation in vars(value).get("__annotations__", {}).items():
            if not field.startswith("_"):
                yield name, field, annotation
        for argument in inspect.signature(value).parameters.values():
            yield name, argument.name, argument.annotation


def test_annotations_are_there_and_say_shapes():
    for name, argument, annotation in annotations():
        assert annotation is not inspect.Signature.empty, f"{name}: {argument} has no annotation"
        text = annotation if isinstance(annotation, str) else getattr(annotation, "__name__", str(annotation))
        assert not re.search(r"\bAny\b", text), f"{name}: {argument} may be Any"
        bare = re.sub(r"(Float|Int|Bool|PyTree)\[[^\]]*\]", "", text)
        assert not re.search(r"\b(Array|ArrayLike)\b", bare), (
            f"{name}: {argument} is an array without a shape"
        )


def test_only_subjects_go_without_a_name():
    for name, function in FOR_PEOPLE:
        positional = [
            p.name
            for p in inspect.signature(function).parameters.values()
            if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD) and p.name not in ("self", "cls")
        ]
        allowed = SUBJECTS | (ASKED_BY_THE_LOOP if name.endswith(".check") else set())
        assert set(positional) <= allowed, f"{name}: {set(positional) - allowed} must be keyword-only"
        if "grasp" in positional and "body" in positional:
            assert positional.index("grasp") < positional.index("body"), name
        if "wrench" in positional:
            assert positional[-1] == "wrench" and len(positional) <= 3, name


def test_at_most_eight_arguments():
    for name, function in FOR_PEOPLE:
        count = len([p for p in inspect.signature(function).parameters if p not in ("self", "cls")])
        assert count <= 8, f"{name} takes {count} arguments"


def test_about_forty_names_at_the_top():
    assert len(set(jg.__all__)) == len(jg.__all__) <= 45
    assert set(jg.__all__) <= set(dir(jg))


@pytest.mark.parametrize("old", sorted(_NEW_PLACES))
def test_old_names_say_where_they_went(old):
    new = _NEW_PLACES[old]
    assert found(new) is not None
    if old in dir(jg):
        return  # a room of that name is there again
    with pytest.raises(AttributeError, match=rf"jaxgrasp\.{old} is now jaxgrasp\.{re.escape(new)}$"):
        getattr(jg, old)


def test_unknown_names_are_unknown():
    with pytest.raises(AttributeError, match="module 'jaxgrasp' has no attribute 'nonsense'"):
        jg.nonsense  # noqa: B018


@pytest.mark.parametrize(
    "room", ["core", "certificates", "backend", "conic", *ROOMS, "formats", "report", "jobs", "cli"]
)
def test_a_room_is_a_module(room):
    assert inspect.ismodule(importlib.import_module(f"jaxgrasp.{room}"))
    if room != "cli":
        assert inspect.ismodule(getattr(jg, room))


def test_help_is_a_glossary():
    for word in (
        "force closure", "form closure", "grasp matrix", "internal force", "soft finger", "Ferrari-Canny",
        "task wrench space", "joint torque limits", "grasp synthesis", "certificate",
    ):  # fmt: skip
        assert word in jg.__doc__.replace("\n      ", " "), word
    for call in re.findall(r"\b([a-z_.]+)\(", jg.__doc__):
        assert callable(found(call)), call


# Answers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("function", "answer"), ANSWERS.items())
def test_an_answer_has_one_status_and_its_bracket_is_lower_and_upper(function, answer):
    kind = found(answer)
    assert inspect.signature(found(function)).return_annotation in (kind, kind.__name__)
    assert issubclass(kind, jg.Answer)
    fields = {f.name: f.type for f in dataclasses.fields(kind)}
    assert str(fields["status"]).startswith("Int[Array")
    assert ("lower" in fields) == ("upper" in fields)
    assert not {"cost", "bound", "value", "feasible", "converged", "kind", "verdict"} & set(fields)
    assert all(word in Status and text.endswith(".") for word, text in kind.SENTENCES.items())


def test_no_answer_is_forgotten():
    for name, function in FOR_PEOPLE:
        returned = inspect.signature(function).return_annotation
        text = returned if isinstance(returned, str) else getattr(returned, "__name__", "")
        kinds = [
            v for _, v in public() if inspect.isclass(v) and issubclass(v, jg.Answer) and v is not jg.Answer
        ]
        if text in {k.__name__ for k in kinds} and "." not in name.removeprefix(name.split(".")[0] + "."):
            assert name in ANSWERS or inspect.isclass(found(name.rsplit(".", 1)[0])), name


def random_grasp(seed, count, k, dimension, model):
    """Contacts round a sphere or a circle, normals within about 20 degrees of its own."""
    rng = np.random.default_rng(seed)
    position = rng.normal(size=(count, k, dimension))
    position /= np.linalg.norm(position, axis=-1, keepdims=True)
    normal = -position + 0.2 * rng.normal(size=position.shape)
    return jg.Grasp(0.05 * position, normal, model)


@pytest.mark.f32
def test_statuses_are_int32_and_brackets_are_in_order(dtype):
    grasp = random_grasp(0, 6, PLANAR, 2, jg.HardFinger(0.6))
    grasp = jax.tree.map(lambda x: x.astype(dtype) if jnp.issubdtype(x.dtype, jnp.floating) else x, grasp)
    wrench, one = np.array([0.3, -1.0, 0.01], dtype), np.eye(2, dtype=dtype)
    body = jg.RigidBody(np.asarray(0.2, dtype), np.asarray(1e-4, dtype))
    limits = jnp.asarray(one), jnp.asarray(one[None])
    answers = [
        jg.wrench_resistance(grasp),
        jg.optimize_forces(grasp, wrench),
        jg.critical_friction(grasp),
        jg.controllability(grasp, body),
        lmi.lmi_feasibility(*limits),
        lmi.lmi_minimize(lmi.LMIProblem(jnp.ones(1, dtype), *limits, jnp.ones(1, dtype))),
        lmi.sdp_minimize(jnp.ones(1, dtype), *limits),
        lmi.lmi_forces(grasp, wrench, criterion=jg.SmallestSum()),
    ]
    for answer in answers:
        name = type(answer).__name__
        assert answer.status.dtype == jnp.int32, name
        assert np.isin(np.asarray(answer.status), [s.value for s in Status]).all()
        assert type(answer).__name__ in str(answer) or answer.batch_shape == ()
        if hasattr(answer, "lower"):
            lower, upper = np.asarray(answer.lower), np.asarray(answer.upper)
            assert np.all((lower <= upper) | np.isnan(lower)), name
            assert lower.shape == answer.status.shape == upper.shape


# Axes of contacts and forces -------------------------------------------------------------------------------------

CASES = {
    "planar hard": (2, PLANAR, jg.HardFinger(0.6)),
    "hard": (3, HARD, jg.HardFinger(0.6)),
    "soft": (3, SOFT, jg.SoftFinger(0.6, 0.004)),
}


@pytest.mark.parametrize("name", CASES)
def test_contact_frames_are_rotations_and_carry_forces(name):
    dimension, k, model = CASES[name]
    grasp = random_grasp(1, 8, k, dimension, model)
    frames = np.asarray(jg.contact_frames(grasp))
    normal = np.asarray(grasp.normal) / np.linalg.norm(grasp.normal, axis=-1, keepdims=True)
    np.testing.assert_allclose(frames[..., -1], normal, atol=1e-6)
    identity = np.broadcast_to(np.eye(dimension), frames.shape)
    np.testing.assert_allclose(np.swapaxes(frames, -1, -2) @ frames, identity, atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(frames), 1.0, atol=1e-6)

    force = np.random.default_rng(2).normal(size=(8, k * model.force_size(dimension)))
    vectors = np.asarray(jg.force_vectors(grasp, jnp.asarray(force, grasp.dtype)))
    wrench = np.einsum("bij,bj->bi", np.asarray(jg.grasp_map(grasp)), force)
    np.testing.assert_allclose(vectors[..., :dimension].sum(axis=1), wrench[:, :dimension], atol=1e-5)
    lever = np.asarray(grasp.position)
    if dimension == 3:
        torque = np.cross(lever, vectors[..., :3]) + (vectors[..., 3:] if vectors.shape[-1] == 6 else 0.0)
        np.testing.assert_allclose(torque.sum(axis=1), wrench[:, 3:], atol=1e-5)
    else:
        torque = lever[..., 0] * vectors[..., 1] - lever[..., 1] * vectors[..., 0]
        np.testing.assert_allclose(torque.sum(axis=1), wrench[:, 2], atol=1e-5)


def turns(rng, count, dimension):
    """Orientations of the body in the world, and their matrices."""
    if dimension == 2:
        angle = rng.uniform(-3, 3, (count, 1))
        c, s = np.cos(angle[:, 0]), np.sin(angle[:, 0])
        return angle, np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], -2)
    q = rng.normal(size=(count, 4))
    w, x, y, z = (q / np.linalg.norm(q, axis=-1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([w, x, y, z], -1), np.moveaxis(np.array(rows), -1, 0)


@pytest.mark.parametrize("name", CASES)
def test_torque_limits_mean_the_same_in_all_axes(name):
    """The motors' torques J^T f are the same numbers, so the answer is; each is proved for the limits as given."""
    dimension, k, model = CASES[name]
    count, rng = 12, np.random.default_rng(3)
    joints, most = (7, 0.25) if name == "hard" else (2, 0.15)  # an arm has seven motors
    grasp = random_grasp(4, count, k, dimension, model)
    wrench = rng.normal(size=(count, 3 if dimension == 2 else 6)) * (
        [1.0] * dimension + [0.02] * (2 * dimension - 3)
    )
    orientation, R = turns(rng, count, dimension)
    frames = np.asarray(jg.contact_frames(grasp))
    r = 2 * dimension if model.force_size(dimension) == 4 else dimension
    body = 0.1 * rng.normal(size=(count, k, r, joints))
    # What a unit of each component is as a vector, written out; and J in the world's axes.
    if r == 6:
        B = np.zeros((count, k, 6, 4))
        B[..., :3, :3], B[..., 3:, 3] = frames, frames[..., -1]
        world = np.concatenate(
            [
                np.einsum("bij,bkjq->bkiq", R, body[..., :3, :]),
                np.einsum("bij,bkjq->bkiq", R, body[..., 3:, :]),
            ],
            -2,
        )
    else:
        B, world = frames, np.einsum("bij,bkjq->bkiq", R, body)
    own = np.einsum("bkrn,bkrq->bknq", B, body).reshape(count, -1, joints)
    tau = np.full(joints, most)
    flat = (count, k * r, joints)
    limits = {
        "contact": jg.TorqueLimits(own, tau),
        "body": jg.TorqueLimits(body.reshape(flat), tau, axes="body"),
        "world": jg.TorqueLimits(world.reshape(flat), tau, axes="world", orientation=orientation),
    }
    asked = {"wrench": wrench, "criterion": jg.SmallestSum()}
    answers = {
        axes: jg.optimize_forces(grasp, wrench, criterion=jg.SmallestSum(), torque_limits=limit)
        for axes, limit in limits.items()
    }
    first = answers["contact"]
    solved = np.isin(np.asarray(first.status), [Status.OPTIMAL, Status.INFEASIBLE])
    optimal = np.asarray(first.status) == Status.OPTIMAL
    assert solved.all() and optimal.sum() >= 3
    for axes, answer in answers.items():
        np.testing.assert_array_equal(answer.status, first.status)
        np.testing.assert_allclose(answer.upper[optimal], first.upper[optimal], rtol=1e-6)
        np.testing.assert_allclose(answer.force, first.force, atol=1e-4 * np.abs(first.force).max())
        assert jg.check(grasp, answer, torque_limits=limits[axes], **asked).all(), axes
        vectors = jg.force_vectors(grasp, answer.force, axes="world", orientation=orientation)
        torque = np.einsum("bkr,bkrq->bq", np.asarray(vectors), world)
        assert np.abs(torque[optimal]).max() <= most * (1 + 1e-6)
    tight = jg.TorqueLimits(
        body.reshape(flat), 0.5 * np.abs(torque[optimal]).min() * np.ones(joints), axes="body"
    )
    assert not jg.check(grasp, first, torque_limits=tight, **asked)[optimal].any()
