"""Error boundary: convert each error to one line on standard error and an exit code."""

from __future__ import annotations

import contextlib
import errno
import io
import json
import logging
import os
import re
import sys
import traceback
import warnings
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import typer

from impact_posture.errors import ImpactPostureError, one_line, printable, remedy
from impact_posture_cli.output import as_options

DEBUG_VARIABLE = "IMPACT_POSTURE_DEBUG"
_INTERRUPTED = 130
# Base class of all usage errors.  Typer may contain its own copy of Click, so the class is taken from Typer.
UsageError: type[Exception] = typer.BadParameter.__mro__[1]


def run(command: Any, arguments: Sequence[str]) -> int:
    """Run a Typer command and return its exit code.

    The exit code is 0 after success, 1 after an error, 2 for a wrong command line, and 130 after Ctrl-C.  Some errors
    have their own exit code.  An error is written as one line to standard error.  With ``--json``, the error is also
    written as ``{"error": {code, kind, what, where, hint}}`` to standard output.
    """
    # Hide the warning that Matplotlib logs if its cache folder is not writable.
    logging.getLogger("matplotlib").setLevel(logging.ERROR)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            # Characters such as λ and × must not raise an error if the terminal cannot encode them.
            stream.reconfigure(errors="replace")
    wants_json = "--json" in arguments
    try:
        with warnings.catch_warnings():
            if not os.environ.get(DEBUG_VARIABLE):
                # Ignore warnings of libraries, for example of an overflow in NumPy, because all results are checked.
                warnings.simplefilter("ignore")
            code = command.main(args=list(arguments), prog_name="impact-posture", standalone_mode=False)
        sys.stdout.flush()
        if code == _INTERRUPTED:  # newer versions of Typer return this code after Ctrl-C
            raise KeyboardInterrupt
        return code if isinstance(code, int) else 0
    except (KeyboardInterrupt, typer.Abort):
        return _report(_Fault(_INTERRUPTED, "Interrupted", "interrupted"), wants_json)
    except SystemExit as error:
        # Rich raises SystemExit if the pipe of its output is closed.
        return error.code if isinstance(error.code, int) else 1
    except Exception as error:
        if isinstance(error, BrokenPipeError) or getattr(error, "errno", None) == errno.EPIPE:
            # End without an error message, because the reader has closed the pipe (for example ``| head``).
            _discard_output()
            return 1
        if os.environ.get(DEBUG_VARIABLE):
            traceback.print_exc()
        if isinstance(error, UsageError):
            return _usage(error, wants_json)
        return _report(_explain(error, arguments), wants_json)


@dataclass(frozen=True)
class _Fault:
    code: int
    kind: str
    what: str
    where: str = ""
    hint: str = ""


def _explain(error: Exception, arguments: Sequence[str]) -> _Fault:
    kind = type(error).__name__
    if isinstance(error, ImpactPostureError):
        # If the error names a parameter whose option is on the command line, name the option instead.
        option = f"--{error.where.partition(' ')[0].replace('_', '-')}"
        typed = any(word.partition("=")[0] == option for word in arguments)
        where = option + error.where[len(option) - 2 :] if typed else error.where
        return _Fault(error.exit_code, kind, as_options(error.what), where, as_options(error.hint))
    if isinstance(error, OSError):
        return _Fault(1, kind, error.strerror or str(error), *_place_and_hint(error))
    if isinstance(error, MemoryError) or "bad_alloc" in str(error):
        hint = "free some, raise its limit (ulimit -v), or give fewer --jobs"
        return _Fault(1, "MemoryError", "out of memory", hint=hint)
    if isinstance(error, RecursionError):
        return _Fault(1, kind, "an input is nested too deeply", hint="correct the file")
    what = f"{kind}: {error}" if str(error) else kind
    hint = f"please report it with the output of {DEBUG_VARIABLE}=1"
    return _Fault(1, "InternalError", what, "internal error", hint)


def _place_and_hint(error: OSError) -> tuple[str, str]:
    """Return the file of an error, and a hint.  If the current folder was deleted, the error names no file."""
    where, hint = str(error.filename or ""), "check the path and its permissions"
    if not where:
        hint = f"{DEBUG_VARIABLE}=1 shows where"
        try:
            os.getcwd()
        except OSError:
            where, hint = "the current folder", "it was deleted: change to another folder"
    return where, "free some space" if error.errno == errno.ENOSPC else remedy(error, hint)


def _usage(error: Any, wants_json: bool) -> int:
    """Print the usage error of Typer without colors, and return its exit code."""
    code = int(getattr(error, "exit_code", 2))
    _reword_choice(error)
    text = io.StringIO()
    error.show(file=text)
    with contextlib.suppress(OSError):
        sys.stderr.write(printable(text.getvalue(), keep="\n"))
    if wants_json:
        context = getattr(error, "ctx", None)
        where = context.command_path if context is not None else "command line"
        _document(_Fault(code, "UsageError", error.format_message(), where, f"see {where} --help"))
    return code


def _reword_choice(error: Any) -> None:
    """Replace the message of Typer for an invalid choice by the message for an invalid choice in a file."""
    # Typer has no setting for the message about an invalid choice.  In all versions, it contains the value and the
    # choices.
    match = re.search(r"'(.*?)' is not one of ('.*)", str(getattr(error, "message", "")))
    if match:
        from impact_posture.errors import not_one_of

        error.message = "; ".join(not_one_of(match[1], re.findall(r"'(.*?)'", match[2])))


def _report(fault: _Fault, wants_json: bool) -> int:
    what, where, hint = (one_line(part) for part in (fault.what, fault.where, fault.hint))
    line = f"{where}: {what}" if where else what
    with contextlib.suppress(OSError):
        sys.stderr.write(f"error: {line}; {hint}\n" if hint else f"error: {line}\n")
        sys.stderr.flush()
    if wants_json:
        _document(replace(fault, what=what, where=where, hint=hint))
    _discard_output()
    return fault.code


def _document(fault: _Fault) -> None:
    with contextlib.suppress(OSError):
        sys.stdout.write(json.dumps({"error": asdict(fault)}, allow_nan=False) + "\n")
        sys.stdout.flush()


def _discard_output() -> None:
    """Discard unwritten output, so that the flush at the end of the interpreter does not fail."""
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except OSError:
            with contextlib.suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
