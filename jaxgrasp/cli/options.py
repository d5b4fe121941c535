"""Commands from requests: the fields of a request dataclass become the options of a command, with their help texts."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable
from dataclasses import MISSING, dataclass, fields
from typing import Annotated, Any, get_type_hints

from ..core import UserError

__all__ = ["Vector", "options"]


@dataclass(frozen=True)
class Vector:
    """A field that is typed as numbers apart by commas: as many as one of ``sizes``; ``means`` says what they are."""

    option: Any
    sizes: tuple[int, ...]
    means: str

    def parsed(self, text: str | None, name: str) -> tuple[float, ...] | None:
        """``text`` as numbers; None stays None. UserError that names the option ``name``."""
        if text is None:
            return None
        try:
            values = tuple(float(part) for part in text.split(","))
        except ValueError:
            values = ()
        if len(values) not in self.sizes:
            raise UserError(f"--{name} must be {self.means}, got {text!r}")
        return values


def options(request: type[Any], told: dict[str, Any]) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Make ``function(request, ..)`` a command whose options are the fields of the dataclass ``request``.

    told  the options in the order of the help: a name, and typer's Argument or Option or a ``Vector`` of one. Types and
          defaults are those of the field of that name, or of the function's own parameter where the request has none.
    """

    def decorate(function: Callable[..., None]) -> Callable[..., None]:
        own = {field.name for field in fields(request)}
        vectors = {name: how for name, how in told.items() if isinstance(how, Vector)}
        parameters = [_parameter(name, how, request, function) for name, how in told.items()]

        @functools.wraps(function)
        def command(**values: Any) -> None:
            for name, how in vectors.items():
                values[name] = how.parsed(values[name], name)
            asked = request(**{name: value for name, value in values.items() if name in own})
            function(asked, **{name: value for name, value in values.items() if name not in own})

        command.__dict__["__signature__"] = inspect.Signature(parameters)
        command.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
        return command

    return decorate


def _parameter(name: str, how: Any, request: type[Any], function: Callable[..., None]) -> inspect.Parameter:
    """The command's parameter ``name``; vectors are typed as text."""
    default: Any
    field = next((field for field in fields(request) if field.name == name), None)
    if field is None:
        default = inspect.signature(function).parameters[name].default
        kind = get_type_hints(function)[name]
    else:
        default = inspect.Parameter.empty if field.default is MISSING else field.default
        kind = get_type_hints(request)[name]
    if isinstance(how, Vector):
        kind, how = str | None, how.option
        default = None if default is None else ",".join(f"{x:g}" for x in default)
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=Annotated[kind, how]
    )
