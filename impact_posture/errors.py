"""Errors that a user can correct.  All errors derive from :class:`ImpactPostureError` and contain a hint.

The command line prints ``what``, ``where`` and ``hint`` as one line and exits with ``exit_code``.
"""

from __future__ import annotations

import difflib
import errno
import math
import reprlib
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import ClassVar, Self

# Largest number of characters of a name in a message.  The middle of a longer name is left out.
_LONGEST_NAME = 200
# Largest number of characters of ``what``, ``where`` or ``hint``, enough to list the 200 joints of a large robot.
_LONGEST_PART = 10_000


def printable(text: str, *, keep: str = "", longest: int = 0) -> str:
    r"""Return text without characters that control a terminal or change the writing direction.

    Control and format characters, line separators and lone surrogates are replaced by escapes such as ``\x1b`` and
    ``\u202e``.

    Args:
        text: Any text.
        keep: Characters that are not replaced, such as line breaks.
        longest: Largest number of characters of the result.  The middle of a longer text is left out; 0 sets no
            limit.
    """
    if longest and len(text) > longest:
        half = longest // 2
        text = f"{text[:half]}…{text[len(text) - half + 1 :]}"
    if text.isprintable():
        return text
    return "".join(c if c in keep or is_visible(c) else c.encode("unicode_escape").decode() for c in text)


def is_visible(character: str) -> bool:
    """Return whether a character is printable or a space."""
    return character.isprintable() or unicodedata.category(character) == "Zs"


def nearest(name: str, known: Iterable[str], count: int = 5) -> list[str]:
    """Return the known names closest to ``name``, best first, or the first known names if none is close."""
    names = list(known)
    folded = {n.casefold(): n for n in names}
    close = [folded[c] for c in difflib.get_close_matches(name.casefold(), folded, n=count, cutoff=0.5)]
    inside = [n for n in names if name.casefold() in n.casefold() and n not in close]
    return (close + inside)[:count] or names[:count]


def one_line(text: str) -> str:
    """Return a message as one line of limited length, without characters that control a terminal."""
    return printable(" ".join(text.split()), longest=_LONGEST_PART)


def listed(names: Sequence[str], most: int = 5) -> str:
    """Return the first names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def shown(value: object) -> str:
    """Return a value as text for a message; the middle of a long value is left out.

    The length is limited during the conversion, because aliases in a short YAML file can define nested lists whose
    text would fill the memory.
    """
    if isinstance(value, str):
        return printable(value, longest=_LONGEST_NAME)
    try:
        return printable(reprlib.repr(value), longest=_LONGEST_NAME)
    except Exception:  # Python does not convert integers of over 4300 digits, and repr may raise any error.
        return type(value).__name__


def not_one_of(value: object, choices: Iterable[str]) -> tuple[str, str]:
    """Return ``what`` and ``hint`` of the error for a value that is not one of the choices."""
    names = list(choices)
    folded = {name.casefold(): name for name in names}
    text = shown(value).casefold()
    begun = [name for name in folded if text and name.startswith(text)]
    close = begun or difflib.get_close_matches(text, folded, n=1, cutoff=0.5)
    what = f"'{shown(value)}' is not one of {', '.join(names)}"
    return what, f"did you mean {folded[close[0]]}?" if close else "choose one of them"


class ImpactPostureError(Exception):
    """Root of all errors of this package.

    Args:
        what: What is wrong, without a full stop.
        where: File, option, joint or frame that is wrong.
        hint: How the user can correct the error.
    """

    exit_code: ClassVar[int] = 1

    def __init__(self, what: str, *, where: str = "", hint: str = "") -> None:
        self.reword(what, where, hint)

    def reword(self, what: str, where: str, hint: str) -> None:
        """Replace the message of this error."""
        self.what, self.where, self.hint = (one_line(text) for text in (what, where, hint))
        self.args = (self.line,)

    @property
    def line(self) -> str:
        """The whole message on one line."""
        text = f"{self.where}: {self.what}" if self.where else self.what
        return f"{text}; {self.hint}" if self.hint else text

    def __reduce__(self) -> tuple[object, ...]:
        # Worker processes pickle errors.  Unpickling must not call the constructors, because constructors of
        # subclasses have other arguments.
        return BaseException.__new__, (type(self), self.line), self.__dict__.copy()


class InputError(ImpactPostureError):
    """A value given by the user is wrong."""

    @classmethod
    def unreadable(cls, path: Path, error: Exception, hint: str = "check the file") -> Self:
        """Return the error for a file that is missing or cannot be read."""
        if isinstance(error, FileNotFoundError):
            return cls("no such file", where=str(path), hint="check the path")
        return cls(f"cannot be read ({_reason(error)})", where=str(path), hint=remedy(error, hint))


class NameNotFound(InputError):
    """A name does not exist; the error contains the nearest valid names."""

    kind: ClassVar[str] = "name"

    def __init__(self, name: str, known: Iterable[str], *, where: str = "", hint: str = "") -> None:
        self.name = name
        self.nearest = nearest(name, known)
        close = ", ".join(printable(other, longest=_LONGEST_NAME) for other in self.nearest)
        guess = f"did you mean {close}?" if self.nearest else "there are none"
        named = printable(name, longest=_LONGEST_NAME)
        super().__init__(f"no {self.kind} '{named}'", where=where, hint=f"{guess} {hint}".strip())


class RobotNotFound(NameNotFound):
    """No robot has this name."""

    kind = "robot"


class FrameNotFound(NameNotFound):
    """The robot has no frame of this name."""

    kind = "frame"


class JointNotFound(NameNotFound):
    """The robot has no joint of this name."""

    kind = "joint"


class JointLocked(JointNotFound):
    """The joint is locked and therefore has no entry in ``q``."""

    def __init__(self, name: str, *, where: str = "") -> None:
        self.name, self.nearest = name, []
        named = printable(name, longest=_LONGEST_NAME)
        InputError.__init__(self, f"joint '{named}' is locked", where=where, hint="leave it out, or do not `lock` it")


class PostureNotFound(NameNotFound):
    """Neither a posture of the robot nor a file has this name."""

    kind = "posture"


class ScenarioNotFound(NameNotFound):
    """No shipped scenario has this name."""

    kind = "scenario"


class ControllerNotFound(NameNotFound):
    """No controller has this name."""

    kind = "controller"


class PackageNotFound(NameNotFound):
    """A ``package://`` or ``example-robot-data:`` path does not exist."""

    kind = "path"


class UrdfError(InputError):
    """The URDF or SRDF cannot be read or does not describe a robot."""


class MjcfError(UrdfError):
    """The MJCF cannot be compiled, or a tree of joints with couplings cannot represent its content."""


class InertiaError(UrdfError):
    """A link's mass or rotational inertia is physically impossible."""


class SpecError(InputError):
    """A robot.toml, problem.toml or another input file has a wrong key or value."""


class PostureError(InputError):
    """A posture has a wrong length or quaternion, or violates the limits."""


class NotWithinLimits(PostureError):
    """A joint is outside its position limits; ``angle`` says whether ``value`` is an angle."""

    def __init__(
        self, joint: str, value: float, lower: float, upper: float, *, where: str = "posture", angle: bool = False
    ) -> None:
        self.joint, self.value, self.lower, self.upper = joint, value, lower, upper
        hint = "choose a posture within the limits or correct them in robot.toml [limits.position]"
        super().__init__(
            f"joint '{joint}' is at {value:.6g}, outside its limits [{lower:.6g}, {upper:.6g}]",
            where=where,
            hint=degrees_hint(value) if angle and abs(value) > 2 * math.pi else hint,
        )


def degrees_hint(value: float) -> str:
    """Return the hint for an angle that is probably in degrees."""
    return f"degrees? Angles are in radians: {value:g}° are {math.radians(value):.6g}"


class ContactError(InputError):
    """A contact is degenerate, because its normal is zero or its frame moves no mass."""


class MetricError(InputError):
    """A metric or objective cannot be computed for this robot or contact."""


class UnsupportedJoint(InputError):
    """The symbolic dynamics do not support a joint type."""


class OutputError(InputError):
    """An output folder exists or cannot be written."""

    @classmethod
    def unwritable(cls, path: Path, error: Exception, hint: str) -> Self:
        """Return the error for a file or folder that cannot be written."""
        return cls(f"cannot be written ({_reason(error)})", where=str(path), hint=remedy(error, hint))


class CompilerError(InputError):
    """The C compiler is missing or failed; the error contains the command and the output."""


class ManifestMismatch(InputError):
    """A C export was made for another robot; the error names the key of the manifest that differs."""

    def __init__(self, key: str, exported: object, found: object, *, where: str = "manifest", hint: str = "") -> None:
        self.key, self.exported, self.found = key, exported, found
        super().__init__(
            f"{key} is {_short(exported)} in the export, but {_short(found)} here",
            where=where,
            hint=hint or "export again for this robot (impact-posture codegen)",
        )


def remedy(error: Exception, hint: str) -> str:
    """Return the hint for a system error.  ``hint`` is the hint for errors that concern the file."""
    number = getattr(error, "errno", None)
    return "raise the limit of open files (ulimit -n)" if number in (errno.EMFILE, errno.ENFILE) else hint


def _reason(error: Exception) -> object:
    return getattr(error, "strerror", None) or error


def _short(value: object) -> str:
    text = repr(value) if not isinstance(value, float) else f"{value:.9g}"
    return text if len(text) <= 80 else f"{text[:12]}…"


# Largest number of conflicts in a message.
_MOST_NAMED = 6


class Infeasible(ImpactPostureError):
    """No posture satisfies the constraints; the error contains the conflicting constraints.

    Args:
        conflicts: Name of each violated constraint and its violation.
        sizes: Violations as texts with units, by name.
        where: Source of the constraints.
        hint: How the user can correct the error.
    """

    exit_code = 3

    def __init__(
        self, conflicts: dict[str, float], sizes: Mapping[str, str] | None = None, *, where: str = "problem",
        hint: str = "",
    ) -> None:  # fmt: skip
        self.conflicts = dict(conflicts)
        texts = {name: f"off by {value:.3g}" for name, value in conflicts.items()} | dict(sizes or {})
        worst = sorted(self.conflicts.items(), key=lambda conflict: -conflict[1])
        named = listed([f"{name} ({texts[name]})" for name, _ in worst], _MOST_NAMED)
        super().__init__(
            f"the constraints conflict: {named}",
            where=where,
            hint=hint or "relax one of them, move the target, or start from another `posture`",
        )


class SolverFailed(ImpactPostureError):
    """The solver did not converge from any start, or no solution passed the optimality check (certificate)."""

    exit_code = 4


class WorkerDied(ImpactPostureError):
    """A worker process ended without a result; the message names the option for the number of workers.

    ``reason`` is the error of an executor that lost its workers on other machines.
    """

    def __init__(self, option: str = "jobs", reason: str = "") -> None:
        what, hint = "a worker process was killed", f"provide more memory, or work in one process: `{option}` 1"
        if reason:
            what, hint = f"the workers were lost ({reason})", "check them, and run the command again to continue"
        super().__init__(what, where=option, hint=hint)


class SimulationDiverged(ImpactPostureError):
    """The state of a simulation diverged; the error contains the time."""

    exit_code = 4

    def __init__(self, time: float, *, where: str = "simulation") -> None:
        self.time = time
        super().__init__(
            f"the state diverged at t = {time:.4g} s",
            where=where,
            hint="lower the time step or the controller's gains, or soften the contact",
        )
