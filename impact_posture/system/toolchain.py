"""Find and run the C compiler of the user."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import subprocess
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from impact_posture.errors import CompilerError
from impact_posture.system.processes import undone

GET_ONE = "install gcc or clang, or set CC"

# Shell script that runs a compiler.  When this Python process ends or closes the pipe, the script kills the compiler
# and all processes that the compiler has started.
_GUARD = (
    "exec 3<&0 </dev/null; { read -r _ <&3; kill -KILL 0; } >/dev/null 2>&1 & "
    '"$@" 3<&-; code=$?; kill -KILL $!; exit $code'
)


def find_compiler() -> list[str] | None:
    """Return the first installed compiler of ``$CC`` (with options), cc, gcc and clang; ``None`` if there is none.

    Raises:
        CompilerError: ``$CC`` has an open quote.
    """
    for command in (words_of("CC"), ["cc"], ["gcc"], ["clang"]):
        if command and shutil.which(command[0]):
            return command
    return None


def require_compiler(where: str) -> list[str]:
    """Return the compiler from :func:`find_compiler`.  Errors name ``where``, the work that needs a compiler.

    Raises:
        CompilerError: No compiler is installed, or ``$CC`` has an open quote.
    """
    compiler = find_compiler()
    if compiler is None:
        raise CompilerError("no C compiler found", where=where, hint=GET_ONE)
    return compiler


def words_of(variable: str) -> list[str]:
    """Return the words of an environment variable, split as a shell does.

    Raises:
        CompilerError: The variable has an open quote.
    """
    text = os.environ.get(variable, "")
    try:
        return shlex.split(text)
    except ValueError as error:
        fault = f"{text!r} cannot be split into words ({str(error).lower()})"
        raise CompilerError(fault, where=variable, hint="close the quote") from None


def run_compiler(command: list[str], folder: Path) -> None:
    """Run a compiler command in ``folder``; see :func:`run_compilers`."""
    run_compilers([command], folder)


def run_compilers(commands: Sequence[list[str]], folder: Path) -> None:
    """Run compiler commands in ``folder`` in parallel, at most one per core.

    Raises:
        CompilerError: A command failed; the error contains the first error line of the first failure.
    """
    waiting, running = list(commands), list[tuple[list[str], subprocess.Popen[str]]]()
    reader, writer = os.pipe()

    def stop() -> None:
        for _, process in running:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            with suppress(ChildProcessError):
                os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)

    try:
        with os.fdopen(reader), os.fdopen(writer, "w"), undone(stop):
            while waiting or running:
                while waiting and len(running) < (os.cpu_count() or 1):
                    command = waiting.pop(0)
                    running.append((command, _start(command, folder, reader)))
                command, process = running[0]
                output = "".join(reversed(process.communicate()))
                running.pop(0)
                _check(command, folder, process.returncode, output)
    finally:
        for _, process in running:
            process.communicate()


def _start(command: list[str], folder: Path, guard: int) -> subprocess.Popen[str]:
    pipe = subprocess.PIPE
    # A killed compiler leaves temporary files behind, so use the folder of the output for them, which is removed
    # afterwards.
    temporary = (folder / command[command.index("-o") + 1]).absolute().parent
    try:
        return subprocess.Popen(
            ["sh", "-c", _GUARD, "sh", *command], cwd=folder, stdin=guard, stdout=pipe, stderr=pipe, text=True,
            errors="replace", start_new_session=True, env=os.environ | {"TMPDIR": str(temporary)},
        )  # fmt: skip
    except OSError as error:
        raise CompilerError(f"{error.strerror} ({shlex.join(command)})", where="C compiler", hint="set CC") from None


def _check(command: list[str], folder: Path, code: int, output: str) -> None:
    if code == 0 and (folder / command[command.index("-o") + 1]).is_file():
        return
    lines = [line for line in output.splitlines() if line.strip()]
    first = next((line for line in lines if "error" in line.lower()), lines[0] if lines else None)
    fault = f"{first or f'no output, exit code {code}'} (command: {shlex.join(command)}, in {folder})"
    raise CompilerError(fault, where="the C compiler failed", hint="check the compiler or set CC to another")
