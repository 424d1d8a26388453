"""Count a C function's arithmetic from its text: operators as written, before the compiler fuses or folds any."""

from __future__ import annotations

import re
from dataclasses import asdict, dataclass

_COMMENT = re.compile(r"/\*.*?\*/|//[^\n]*|^\s*#[^\n]*(?:\\\n[^\n]*)*", re.S | re.M)
_TOKEN = re.compile(
    r"(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?[fFuUlL]*)|(?P<word>[A-Za-z_]\w*)"
    r"|(?P<op>\+\+|--|[-+*/]=|->|[-+*/=(){}\[\],;<>!&|?:%.~^])"
)
_TYPES = frozenset("double float int void char long unsigned const restrict casadi_real casadi_int".split())


@dataclass(frozen=True)
class Operations:
    """Arithmetic on single numbers.

    Attributes:
        add: Additions and subtractions.
        mul: Multiplications.
        div: Divisions.
        trig: Sines and cosines.
        neg: Sign changes.
        packed: Of the whole, how many operations it is once vectors do several numbers at a time; ``None``: no
            vectors in the source.
    """

    add: int = 0
    mul: int = 0
    div: int = 0
    trig: int = 0
    neg: int = 0
    packed: int | None = None

    @property
    def total(self) -> int:
        """All but sign changes, which compilers fold."""
        return self.add + self.mul + self.div + self.trig

    def to_dict(self) -> dict[str, int | None]:
        """For a JSON document."""
        return {"total": self.total, **asdict(self)}

    def __add__(self, other: Operations) -> Operations:
        return Operations(
            self.add + other.add, self.mul + other.mul, self.div + other.div, self.trig + other.trig,
            self.neg + other.neg,
        )  # fmt: skip


def count_operations(source: str, function: str) -> Operations:
    """Operations of a function and of the functions of the same text that it calls, each call counted once a place.

    Loops count once; array indices do not count.
    """
    bodies = _bodies(_COMMENT.sub(" ", source))
    return _count(function, bodies, {})


def reachable_kb(source: str, function: str) -> float:
    """Size of a function's body with those of the same text that it calls, kB."""
    bodies = _bodies(_COMMENT.sub(" ", source))
    found, waiting = set(), [function]
    while waiting:
        name = waiting.pop()
        found.add(name)
        called = set(re.findall(r"[A-Za-z_]\w*", bodies[name])) & bodies.keys()
        waiting += called - found - set(waiting)
    return sum(len(bodies[name].encode()) for name in found) / 1e3


def _bodies(text: str) -> dict[str, str]:
    """Name → body of every function, by its braces."""
    found: dict[str, str] = {}
    for match in re.finditer(r"\b([A-Za-z_]\w*)\s*\(([^(){};]*)\)\s*\{", text):
        if match[1] in ("if", "for", "while", "switch"):
            continue
        depth, at = 1, match.end()
        while depth and at < len(text):
            depth += {"{": 1, "}": -1}.get(text[at], 0)
            at += 1
        found[match[1]] = text[match.end() : at - 1]
    return found


def _count(name: str, bodies: dict[str, str], known: dict[str, Operations]) -> Operations:
    if name in known:
        return known[name]
    known[name] = Operations()  # recursion, which there is none of, would count once
    add = mul = div = trig = neg = 0
    called = Operations()
    before, depth, header = "", 0, 0
    for match in _TOKEN.finditer(bodies[name]):
        token = match[0]
        if token == "[":
            depth += 1
        elif token == "]":
            depth -= 1
        elif token == "for":
            header = 1
        if header:
            # A loop's own counting is no arithmetic.
            header += {"(": 1, ")": -1}.get(token, 0)
            header = 0 if header == 1 and token == ")" else header
        elif depth == 0:
            binary = bool(re.fullmatch(r"[\w.]+|\)|\]", before)) and before not in _TYPES and before != "return"
            if token in "+-" or token in ("+=", "-="):
                add, neg = (add + 1, neg) if binary else (add, neg + (token == "-"))
            elif token in ("*", "*="):
                mul += binary
            elif token in ("/", "/="):
                # By a literal it is a product once compiled: those that are written are powers of two.
                literal = re.match(r"\s*\d", bodies[name][match.end() : match.end() + 8])
                div, mul = (div, mul + 1) if literal else (div + 1, mul)
            elif token in ("sin", "cos", "sinf", "cosf"):
                trig += 1
            elif match["word"] and token in bodies:
                called = called + _count(token, bodies, known)
        # A negative literal changes no sign at run time.
        if match["number"] and before == "-" and neg and not binary:
            neg -= 1
        before = token
    known[name] = Operations(add, mul, div, trig, neg) + called
    return known[name]
