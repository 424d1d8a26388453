"""Write numbers as C text: floating-point type of an export, literals, and initializers of arrays."""

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
    """The floating-point type of the numbers in an export.

    Attributes:
        name: C name of the type, ``double`` or ``float``.
        size: Size of a number, bytes.
        unit_tolerance: Largest permitted difference between 1 and the norm of a quaternion or cosine-sine pair.
    """

    name: str
    size: int
    unit_tolerance: float

    @property
    def dtype(self) -> np.dtype[np.floating[Any]]:
        """NumPy type with the same size as the C type."""
        return np.dtype(np.float64 if self.name == "double" else np.float32)

    def rounded(self, values: ArrayLike) -> NDArray[np.float64]:
        """Round numbers to this type, and return them as doubles."""
        return np.array(values, dtype=self.dtype).astype(np.float64)

    def literal(self, value: float) -> str:
        """Return the C literal of ``value`` rounded to this type; a negative literal is in parentheses."""
        if self.name == "double" or not math.isfinite(value):
            return c_double(value)
        with np.errstate(over="ignore", under="ignore"):
            nearest = np.float32(value)
        text = c_double(float(str(nearest)))
        if not np.isfinite(nearest):
            return text
        return f"{text[:-1]}f)" if text.endswith(")") else f"{text}f"

    def plain(self, value: float) -> str:
        """Return the C literal of ``value`` without parentheses, for use in an initializer."""
        return self.literal(float(value)).strip("()")

    def initializer(self, values: Sequence[float], indent: str = "") -> str:
        """Return the C initializer of an array in braces, with four numbers per line."""
        return brace_initializer([self.plain(v) for v in values], 4, indent)

    def spelled(self, operation: str) -> str:
        """Translate a C expression for doubles to this type: for ``float``, ``sin(1.0)`` becomes ``sinf(1.0f)``."""
        if self.name == "double":
            return operation
        text = _MATH.sub(r"\1f(", operation).replace("(double)", "(float)")
        return re.sub(r"\b\d+\.\d+", r"\g<0>f", text)


DOUBLE = Real("double", 8, 1e-6)
FLOAT = Real("float", 4, 1e-5)
REALS = {real.name: real for real in (DOUBLE, FLOAT)}


def c_double(value: float) -> str:
    """Return the C literal of a double, without rounding; a negative literal is in parentheses."""
    if math.isnan(value):
        return "NAN"
    text = "INFINITY" if math.isinf(value) else repr(abs(value))
    return f"(-{text})" if math.copysign(1.0, value) < 0 else text


def brace_initializer(texts: Sequence[str], count: int, indent: str) -> str:
    """Return the C initializer of an array in braces, with ``count`` entries per line."""
    rows = [", ".join(texts[k : k + count]) for k in range(0, len(texts), count)]
    return "{\n" + ",\n".join(f"{indent}  {row}" for row in rows) + f"\n{indent}}}"
