"""Check whether the arguments of a Python call agree with the annotations of the called function.

The function ``validate_call`` of Pydantic accepts text as a number, and rejects a NumPy array as a sequence.  Users
of this package pass arrays, so this module has its own check.
"""

from __future__ import annotations

import builtins
import inspect
import sys
from collections.abc import Callable, Collection, Mapping, Set
from functools import cache, wraps
from numbers import Integral, Real
from types import SimpleNamespace, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from impact_posture.config.demand import Demand
from impact_posture.errors import InputError, not_one_of, shown

_Target = TypeVar("_Target", bound=Callable[..., Any])

_NUMBERS = {int: Integral, float: Real}
_WORDS = {int: "a whole number", float: "a number", str: "text", bool: "True or False", type(None): "None"}


def checked(target: _Target) -> _Target:
    """Make a function, or the constructor of a class, reject arguments that contradict their annotations.

    An argument must have the annotated type and satisfy every :class:`Demand` in the annotation.  NumPy numbers and
    arrays are accepted as numbers and sequences.  Annotations that this module does not know accept every value.

    Raises:
        InputError: An argument contradicts its annotation; the error names the parameter.
    """
    function: Callable[..., Any] = target.__init__ if isinstance(target, type) else target  # type: ignore[misc]
    signature = inspect.signature(function)

    @wraps(function)
    def check_and_call(*arguments: Any, **options: Any) -> Any:
        try:
            values = signature.bind(*arguments, **options).arguments
        except TypeError:
            return function(*arguments, **options)  # The call raises a TypeError that names the wrong argument.
        annotations = _annotations(target)
        for name, value in values.items():
            hint = hint_for(value, annotations[name]) if name in annotations else ""
            if hint:
                raise _refusal(value, annotations[name], name, hint)
        return function(*arguments, **options)

    if isinstance(target, type):
        target.__init__ = check_and_call  # type: ignore[misc]
        return target
    return check_and_call  # type: ignore[return-value]


class _Named:
    """Base of stand-ins for classes imported under ``TYPE_CHECKING``; values match by class name."""


class _Names(dict[str, Any]):
    def __missing__(self, name: str) -> type:
        return type(name, (_Named,), {})


@cache
def _annotations(target: Callable[..., object]) -> dict[str, Any]:
    """Return the annotations of the parameters of a function or constructor, without ``**options``."""
    function: Callable[..., object] = target.__init__ if isinstance(target, type) else target  # type: ignore[misc]
    names = {p.name for p in inspect.signature(function).parameters.values() if p.kind is not p.VAR_KEYWORD}
    # The annotations of inherited fields contain names of the module that defines the base class.
    is_dataclass = isinstance(target, type) and "__dataclass_params__" in vars(target)
    annotations: dict[str, Any] = {}
    for owner in reversed(target.__mro__) if is_dataclass else [function]:  # type: ignore[attr-defined]
        own = inspect.get_annotations(owner)
        texts = SimpleNamespace(__annotations__={name: own[name] for name in names & own.keys()})
        known = _Names(vars(builtins) | vars(sys.modules[owner.__module__]))
        annotations |= get_type_hints(texts, localns=known, include_extras=True)
    return annotations


def _refusal(value: object, annotation: Any, name: str, hint: str) -> InputError:
    what = f"is {repr(shown(value)) if isinstance(value, str) else shown(value)}"
    for part in (annotation, *get_args(annotation)):
        if get_origin(part) is Literal and isinstance(get_args(part)[0], str):
            what, hint = not_one_of(value, get_args(part))
    return InputError(what, where=name, hint=hint)


def hint_for(value: object, annotation: Any) -> str:
    """Return a hint on valid values for an error message; empty if ``value`` is valid."""
    if get_origin(annotation) in (Union, UnionType):
        parts = _alternatives(get_args(annotation))
        if any(_fits(value, part) for part in parts):
            return ""
        # If the value has the type of one alternative of a union, the Demand of this alternative gives the hint.
        close = [part for part in parts if get_origin(part) is Annotated and _fits(value, get_args(part)[0])]
        return hint_for(value, close[0]) if close else f"give {_words(annotation)}"
    base, *demands = get_args(annotation) if get_origin(annotation) is Annotated else (annotation,)
    if not _fits(value, base):
        return f"give {_words(annotation)}"
    for demand in demands:
        try:
            if isinstance(demand, Demand):
                demand.check(value)
        except ValueError as error:
            return str(error)
    return ""


def _fits(value: object, annotation: Any) -> bool:
    """Return whether a value has the annotated type; true for annotations that this module does not know."""
    import numpy as np
    from numpy.typing import ArrayLike

    origin, parts = get_origin(annotation), get_args(annotation)
    if annotation in (Any, object) or isinstance(annotation, TypeVar):
        return True
    if annotation == ArrayLike or origin is np.ndarray:
        return _is_numeric(value) and (annotation == ArrayLike or np.ndim(value) > 0)  # type: ignore[arg-type]
    if origin is Annotated:
        return not hint_for(value, annotation)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in _alternatives(parts))
    if origin is Literal:
        return isinstance(value, type(parts[0])) and not isinstance(value, bool) and value in parts
    if origin is Callable or annotation is Callable:
        return callable(value)
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, Mapping) and all(
            _fits(key, parts[0]) and _fits(entry, parts[1]) for key, entry in value.items()
        )
    if isinstance(origin, type) and issubclass(origin, Collection):
        if isinstance(value, str | bytes | Mapping) or not isinstance(value, Collection):
            return False
        if (isinstance(value, np.ndarray) and value.ndim == 0) or (isinstance(value, Set) and parts[0] is float):
            # Neither an array without axes nor a set is a sequence.
            return False
        if origin is tuple and parts[-1] is not ...:
            return len(value) == len(parts) and all(map(_fits, value, parts))
        return all(_fits(entry, parts[0]) for entry in value)
    if isinstance(annotation, type) and getattr(annotation, "_is_protocol", False):
        members = {name for name in {**vars(annotation), **inspect.get_annotations(annotation)} if name[0] != "_"}
        return all(hasattr(type(value), name) or name in getattr(value, "__dict__", ()) for name in members)
    if isinstance(annotation, type) and issubclass(annotation, _Named):
        return any(base.__name__ == annotation.__name__ for base in type(value).__mro__)
    if annotation in _NUMBERS:
        is_number = isinstance(value, _NUMBERS[annotation]) and not isinstance(value, bool)
        return is_number and (annotation is int or _is_float(value))
    if annotation is bool:
        return isinstance(value, bool | np.bool_)
    kind = origin or annotation
    return isinstance(value, kind) if isinstance(kind, type) else True


def _alternatives(parts: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the alternatives of a union.  Python splits ``ArrayLike`` into many alternatives; merge them again."""
    from numpy.typing import ArrayLike

    numeric = get_args(ArrayLike)
    whole = set(numeric) <= set(parts)
    return (ArrayLike, *(part for part in parts if part not in numeric)) if whole else parts


def _is_numeric(value: object) -> bool:
    import numpy as np

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


def _words(annotation: Any) -> str:
    origin, parts = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return next((part.words for part in parts if isinstance(part, Demand)), _words(parts[0]))
    if getattr(origin, "__name__", "") == "ndarray":
        return "numbers"
    if origin in (Union, UnionType):
        from numpy.typing import ArrayLike

        words = ("numbers" if part == ArrayLike else _words(part) for part in _alternatives(parts))
        return " or ".join(dict.fromkeys(words))
    if origin is Literal:
        return ", ".join(map(str, parts))
    if origin is tuple and parts[-1] is not ...:
        return f"({', '.join(map(_words, parts))})"
    if origin is Callable:
        return "a function"
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return "a table"
    if isinstance(origin, type) and issubclass(origin, Collection) and parts:
        return f"a list of {_words(parts[0])}"
    return _WORDS.get(annotation, getattr(annotation, "__name__", str(annotation)))
