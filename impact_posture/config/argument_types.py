"""Check of the arguments from Python against the annotations of the function that takes them.

Libraries that check types while a program runs refuse NumPy's numbers for ``int`` and ``float``, and arrays for
sequences.  Users of this package pass both, so they count here.
"""

from __future__ import annotations

import builtins
import inspect
from collections.abc import Callable, Collection, Mapping, Set
from functools import cache, wraps
from numbers import Integral, Real
from types import UnionType
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from impact_posture.errors import InputError, not_one_of, shown

_Arguments = ParamSpec("_Arguments")
_Return = TypeVar("_Return")
_Class = TypeVar("_Class", bound=type)

_NUMBERS = {int: Integral, float: Real}
_WORDS = {int: "a whole number", float: "a number", str: "text", bool: "True or False", type(None): "None"}


def checked(function: Callable[_Arguments, _Return]) -> Callable[_Arguments, _Return]:
    """Let a function refuse arguments whose type is none of its annotation, by an InputError that names them.

    Types that are not understood allow everything.
    """
    signature = inspect.signature(function)

    @wraps(function)
    def check_and_call(*arguments: _Arguments.args, **options: _Arguments.kwargs) -> _Return:
        try:
            given = signature.bind(*arguments, **options).arguments
        except TypeError:
            return function(*arguments, **options)  # Python says which argument is missing or too many.
        check_types(function, given)
        return function(*arguments, **options)

    return check_and_call


def checked_class(cls: _Class) -> _Class:
    """Let the constructor of a class, for example of a dataclass, refuse wrong types in the same way."""
    cls.__init__ = checked(cls.__init__)  # type: ignore[misc]
    return cls


def check_types(owner: Callable[..., object], values: Mapping[str, object]) -> None:
    """Check values by name against the annotations of a function or of the fields of a class.

    Raises:
        InputError: A value has another type; the error names the parameter.
    """
    hints = _hints(owner)
    for name, value in values.items():
        hint = hints.get(name, Any)
        if _fits(value, hint):
            continue
        choices = [word for part in (hint, *get_args(hint)) if get_origin(part) is Literal for word in get_args(part)]
        what, remedy = not_one_of(value, choices) if choices else (f"is {_quoted(value)}", f"give {_words(hint)}")
        raise InputError(what, where=name, hint=remedy)


class _Named:
    """Base of stand-ins for classes that only type checkers import, whose instances are known by their names."""


class _Names(dict[str, Any]):
    """Names of a module, with a stand-in for each missing one."""

    def __missing__(self, name: str) -> type:
        return type(name, (_Named,), {})


@cache
def _hints(owner: Callable[..., object]) -> dict[str, Any]:
    """Return the types of the parameters of a function, without the open ended ``**options``."""
    names = _Names(vars(builtins) | getattr(owner, "__globals__", {}))
    found = get_type_hints(owner, localns=names)
    kept = [p.name for p in inspect.signature(owner).parameters.values() if p.kind is not p.VAR_KEYWORD]
    return {name: found[name] for name in kept if name in found}


def _quoted(value: object) -> str:
    return repr(shown(value)) if isinstance(value, str) else shown(value)


def _fits(value: object, hint: Any) -> bool:
    """Whether a value may be of a type; true for types that are not understood."""
    origin, parts = get_origin(hint), get_args(hint)
    if hint in (Any, object) or isinstance(hint, TypeVar):
        return True
    if hint == ArrayLike or origin is np.ndarray:
        return _is_numeric(value) and (hint == ArrayLike or np.ndim(value) > 0)  # type: ignore[arg-type]
    if origin is Annotated:
        return _fits(value, parts[0])
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in _alternatives(parts))
    if origin is Literal:
        return isinstance(value, str) and value in parts
    if origin is Callable or hint is Callable:
        return callable(value)
    if isinstance(origin, type) and issubclass(origin, Collection) and not issubclass(origin, Mapping):
        if isinstance(value, str | bytes | Mapping) or not isinstance(value, Collection):
            return False
        if (isinstance(value, np.ndarray) and value.ndim == 0) or (isinstance(value, Set) and parts[0] is float):
            # An array without axes has no entries, and those of a set have no order.
            return False
        if origin is tuple and parts[-1] is not ...:
            return len(value) == len(parts) and all(map(_fits, value, parts))
        return all(_fits(entry, parts[0]) for entry in value)
    if isinstance(hint, type) and getattr(hint, "_is_protocol", False):
        members = {name for name in {**vars(hint), **inspect.get_annotations(hint)} if not name.startswith("_")}
        return all(hasattr(type(value), name) or name in getattr(value, "__dict__", ()) for name in members)
    if isinstance(hint, type) and issubclass(hint, _Named):
        return any(base.__name__ == hint.__name__ for base in type(value).__mro__)
    if hint in _NUMBERS:
        return isinstance(value, _NUMBERS[hint]) and not isinstance(value, bool) and (hint is int or _is_float(value))
    if hint is bool:
        return isinstance(value, bool | np.bool_)
    kind = origin or hint
    return isinstance(value, kind) if isinstance(kind, type) else True


def _alternatives(parts: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the parts of a union, with the many parts of ``ArrayLike``, which Python merges into it, as one."""
    numeric = get_args(ArrayLike)
    whole = set(numeric) <= set(parts)
    return (ArrayLike, *(part for part in parts if part not in numeric)) if whole else parts


def _is_numeric(value: object) -> bool:
    try:
        return np.asarray(value).dtype.kind in "biuf"
    except ValueError:  # a ragged list
        return False


def _is_float(value: Any) -> bool:
    try:
        float(value)
    except OverflowError:  # an integer of more than 308 digits
        return False
    return True


def _words(hint: Any) -> str:
    """Return the name of a type for people."""
    origin, parts = get_origin(hint), get_args(hint)
    if hint == ArrayLike or origin is np.ndarray:
        return "numbers"
    if origin in (Union, UnionType):
        return " or ".join(dict.fromkeys(_words(part) for part in _alternatives(parts)))
    if origin is Literal:
        return ", ".join(map(str, parts))
    if origin is tuple and parts[-1] is not ...:
        return f"({', '.join(map(_words, parts))})"
    if origin is Callable:
        return "a function"
    if isinstance(origin, type) and issubclass(origin, Collection) and parts:
        return f"a list of {_words(parts[0])}" if not issubclass(origin, Mapping) else "a table"
    return _WORDS.get(hint, getattr(hint, "__name__", str(hint)))
