"""Numbers as C text: the number type of an export, its literals and initializers."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_MATH = re.compile(r"\b(exp|log|pow|sqrt|a?sin|a?cos|a?tan|atan2|tanh|hypot|fabs|fmin|fmax)\(")


@dataclass(frozen=True)
class Real:
    """The number type of an export.

    Attributes:
        name: ``double`` or ``float``.
        size: Bytes of a number.
        unit_tolerance: Largest deviation of the norm of a quaternion from one.
    """

    name: str
    size: int
    unit_tolerance: float

    @property
    def dtype(self) -> np.dtype[np.floating[Any]]:
        """The same type in NumPy."""
        return np.dtype(np.float64 if self.name == "double" else np.float32)

    def rounded(self, values: ArrayLike) -> NDArray[np.float64]:
        """Return numbers rounded to this type, as doubles."""
        return np.array(values, dtype=self.dtype).astype(np.float64)

    def literal(self, value: float) -> str:
        """Return the literal of the nearest number of this type; a negative literal is in parentheses."""
        if self.name == "double" or not math.isfinite(value):
            return c_double(value)
        with np.errstate(over="ignore", under="ignore"):
            nearest = np.float32(value)
        text = c_double(float(str(nearest)))
        if not np.isfinite(nearest):
            return text
        return f"{text[:-1]}f)" if text.endswith(")") else f"{text}f"

    def plain(self, value: float) -> str:
        """Return a literal without parentheses, for an initializer."""
        return self.literal(float(value)).strip("()")

    def initializer(self, values: Sequence[float], indent: str = "") -> str:
        """Return a brace initializer with four numbers a line."""
        return brace_initializer([self.plain(v) for v in values], 4, indent)

    def spelled(self, operation: str) -> str:
        """Translate the C of an operation on doubles to this type: ``sinf`` for ``sin``, ``1.0f`` for ``1.0``."""
        if self.name == "double":
            return operation
        text = _MATH.sub(r"\1f(", operation).replace("(double)", "(float)")
        return re.sub(r"\b\d+\.\d+", r"\g<0>f", text)


DOUBLE = Real("double", 8, 1e-6)
FLOAT = Real("float", 4, 1e-5)
REALS = {real.name: real for real in (DOUBLE, FLOAT)}


def c_double(value: float) -> str:
    """Return a double literal that reads back exactly; a negative literal is in parentheses."""
    if math.isnan(value):
        return "NAN"
    text = "INFINITY" if math.isinf(value) else repr(abs(value))
    return f"(-{text})" if math.copysign(1.0, value) < 0 else text


def brace_initializer(texts: Sequence[str], count: int, indent: str) -> str:
    """Return a brace initializer with ``count`` entries a line."""
    rows = [", ".join(texts[k : k + count]) for k in range(0, len(texts), count)]
    return "{\n" + ",\n".join(f"{indent}  {row}" for row in rows) + f"\n{indent}}}"
