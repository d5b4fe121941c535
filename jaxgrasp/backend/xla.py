"""Where the compiler must cut: a ``stage`` is computed once and stored, a ``kernel`` becomes one function.

XLA's CPU backend fuses producers into every consumer and recomputes them there; it starts each fusion as a separate
task of about 0.2 us. For 64 lanes of a few hundred floats both cost more than the arithmetic. Two attributes, which
JAX lets us put on calls, change that: a call that may not be inlined keeps its results (``stage``), and a "small
call" is compiled into one function without tasks inside (``kernel``). Measured on one core at k = 4, float64: a
Newton step costs 0.87 us a lane without, 0.53 with stages, 0.26 with both. A backend that does not know the
attributes ignores them: the numbers stay right.

Everything of JAX and XLA that no document promises is used here and nowhere else, after a probe. Where the probe fails
and on accelerators, stages and kernels are plain functions behind an optimisation barrier: slower on the CPU, with the
same verdicts.

``JAXGRASP_KERNELS=off`` in the environment, read when a function is traced, makes kernels plain functions: slower,
with the same verdicts. A way round a compiler that trips over them, and the other side of a comparison. Stages stay: a
value that two fusions compute twice is rounded twice, and a step that was checked is then not the step taken.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer

__all__ = ["fori_loop", "inlined", "is_traced", "kernel", "stage", "varying_like", "while_loop"]

SWITCH = "JAXGRASP_KERNELS"

_INLINED: ContextVar[bool] = ContextVar("stages are plain functions here", default=False)

_KEPT = {"inlineable": "false"}
_SMALL = {"inlineable": "false", "xla_cpu_small_call": "true"}


def is_traced(tree: Any) -> bool:
    """Whether a leaf of ``tree`` stands for a number that is not known yet: under ``jit``, ``vmap`` or ``grad``."""
    return any(isinstance(x, Tracer) for x in jax.tree.leaves(tree))


def _varying(x: Any) -> frozenset[str]:
    """The axes of ``jax.shard_map`` along which x differs from device to device, as far as this JAX says so."""
    kind = jax.typeof(x)
    kind = getattr(kind, "manual_axis_type", None) or kind
    return frozenset(getattr(kind, "varying", None) or getattr(kind, "vma", None) or ())


def varying_like(tree: Any) -> Callable[[Any], Any]:
    """What makes all arrays of a tree differ between devices where one of ``tree`` does; elsewhere it changes nothing.

    ``jax.shard_map`` checks that a loop's carry, or both ways of a choice, agree in that.
    """
    axes = frozenset().union(*(_varying(x) for x in jax.tree.leaves(tree)))

    def cast(x: Any) -> Any:
        missing = tuple(axes - _varying(x))
        return lax.pcast(x, missing, to="varying") if missing else x

    return functools.partial(jax.tree.map, cast)


def while_loop(
    unfinished: Callable[[Any], Any], body: Callable[[Any], Any], init: Any, like: Any = ()
) -> Any:
    """``lax.while_loop`` that ``jax.shard_map`` can check: ``init`` may hold constants, the same on every device.

    ``like``  what ``body`` reads besides: its results differ between devices where this does
    """
    cast = varying_like((init, like))
    return lax.while_loop(unfinished, lambda carry: cast(body(carry)), cast(init))


def fori_loop(lower: int, upper: int, body: Callable[[Any, Any], Any], init: Any, like: Any = ()) -> Any:
    """``lax.fori_loop``, as ``while_loop``."""
    cast = varying_like((init, like))
    return lax.fori_loop(lower, upper, lambda i, carry: cast(body(i, carry)), cast(init))


@contextmanager
def inlined(on: bool = True) -> Iterator[None]:
    """Stages traced inside are plain functions, which JAX differentiates, batches and transposes as it likes.

    ``inlined(False)`` inside it: stages again, for what JAX is told not to look into.
    """
    token = _INLINED.set(on)
    try:
        yield
    finally:
        _INLINED.reset(token)


def _called(function: Callable, attributes: dict[str, str]) -> Callable:
    """``function`` as a call that carries ``attributes``; the operations inside carry none."""
    traced: dict[Any, _Traced] = {}

    @functools.wraps(function)
    def wrapper(*args: Any) -> Any:
        if _INLINED.get() or jax.config.jax_disable_jit:  # pyright: ignore[reportAttributeAccessIssue]
            return function(*args)
        if jax.default_backend() != "cpu" or not _attributes_known():
            # Fusions that compute a value twice round it twice, and a step that was checked is then not the step taken.
            return lax.optimization_barrier(function(*args))
        if attributes is _SMALL and os.environ.get(SWITCH, "on").lower() == "off":
            return function(*args)
        return _call(function, attributes, args, traced)

    return wrapper


class _Traced(NamedTuple):
    """A function traced for arguments of one kind: the call, which inputs it reads, and the tree of its results."""

    jaxpr: Any  # one equation, the call; none where the results are arguments
    consts: list[Any]
    used: list[bool]
    results: Any


def _traced(function: Callable, args: tuple[Any, ...]) -> _Traced:
    """Inputs that nothing reads are dropped: the CPU backend aborts on a small call with one."""
    # Imported here, so that a JAX without it fails the probe and not the import of the library.
    from jax.interpreters.partial_eval import dce_jaxpr

    def body(*args: Any) -> Any:
        return function(*args)

    body.__name__ = getattr(function, "__name__", "stage").strip("_")
    outer, shape = jax.make_jaxpr(jax.jit(body), return_shape=True)(*args)
    live, used = dce_jaxpr(outer.jaxpr, [True] * len(outer.jaxpr.outvars))
    return _Traced(live, outer.consts, used, jax.tree.structure(shape))


def _kind(args: tuple[Any, ...]) -> Any:
    """What a trace depends on: shapes, types and tree of the arguments, and JAX's rules for types."""
    leaves, tree = jax.tree.flatten(args)
    shapes = tuple(
        (np.shape(x), jnp.result_type(x), getattr(jax.typeof(x), "weak_type", False), _varying(x))
        for x in leaves
    )
    rules = [getattr(jax.config, name) for name in ("jax_enable_x64", "jax_numpy_dtype_promotion")]
    return tree, shapes, jax.sharding.get_abstract_mesh(), *rules


def _call(
    function: Callable, attributes: dict[str, str], args: tuple[Any, ...], known: dict[Any, _Traced]
) -> Any:
    """The call itself. Traced once for arguments of one kind, so that it also lowers once."""
    from jax.experimental.xla_metadata import set_xla_metadata

    kind = _kind(args)
    found = known.get(kind)
    if found is None:
        found = _traced(function, args)
        if not is_traced(found.consts):  # numbers of one trace mean nothing in another
            known[kind] = found
    inputs = [x for x, keep in zip(jax.tree.leaves(args), found.used, strict=True) if keep]
    values = dict(zip(found.jaxpr.invars, inputs, strict=True))
    values.update(zip(found.jaxpr.constvars, found.consts, strict=True))

    def read(v: Any) -> Any:
        return v.val if hasattr(v, "val") else values[v]  # a literal, or a variable

    for call in found.jaxpr.eqns:
        with set_xla_metadata(**attributes):
            results = call.primitive.bind(*(read(v) for v in call.invars), **call.params)
        values.update(zip(call.outvars, results, strict=True))
    return jax.tree.unflatten(found.results, [read(v) for v in found.jaxpr.outvars])


@functools.cache
def _attributes_known() -> bool:
    """Whether a call with attributes can be traced with this JAX, and carries them into the program it lowers to."""

    def probe(x: jax.Array, unread: jax.Array) -> jax.Array:
        return _call(lambda x, unread: 2 * x, _SMALL, (x, unread), {})

    try:
        number = jax.ShapeDtypeStruct((), jnp.float32)
        text = jax.jit(probe).lower(number, number).as_text()
    except Exception:  # whatever an unknown version may raise
        return False
    return all(name in text for name in _SMALL)


def stage(function: Callable) -> Callable:
    """Keep the results of ``function`` instead of recomputing them in every consumer."""
    return _called(function, _KEPT)


def kernel(function: Callable) -> Callable:
    """Compile ``function``, loops included, into one function of the CPU backend."""
    return _called(function, _SMALL)
