"""The user's C compiler: found once, called one way."""

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
from impact_posture.processes import undone

# A compiler is several processes.  They are one group, which ends when the pipe on standard input does: when this
# process closes it, and when this process is killed.
_GUARD = (
    "exec 3<&0 </dev/null; { read -r _ <&3; kill -KILL 0; } >/dev/null 2>&1 & "
    '"$@" 3<&-; code=$?; kill -KILL $!; exit $code'
)


def find_compiler() -> list[str] | None:
    """The C compiler as the head of a command: ``$CC`` (which may carry options), cc, gcc or clang; else ``None``.

    Raises:
        CompilerError: ``$CC`` is no command: a quote is open.
    """
    for words in (words_of("CC"), ["cc"], ["gcc"], ["clang"]):
        if words and shutil.which(words[0]):
            return words
    return None


def words_of(variable: str) -> list[str]:
    """An environment variable's words, split as a shell does.

    Raises:
        CompilerError: A quote is open.
    """
    text = os.environ.get(variable, "")
    try:
        return shlex.split(text)
    except ValueError as error:
        raise CompilerError(
            f"{text!r} cannot be split into words ({str(error).lower()})", where=variable, hint="close the quote"
        ) from None


def run_compiler(command: list[str], folder: Path) -> None:
    """Run a compiler's command in ``folder``.

    Raises:
        CompilerError: With the compiler's first error line and the command.
    """
    run_compilers([command], folder)


def run_compilers(commands: Sequence[list[str]], folder: Path) -> None:
    """Run compilers' commands in ``folder``, as many at once as there are cores, in this order.

    Raises:
        CompilerError: With the first error line of the first one that failed, and its command.
    """
    waiting, running = list(commands), list[tuple[list[str], subprocess.Popen[str]]]()
    reader, writer = os.pipe()

    def stop() -> None:
        """Leave none behind, nor what it has started itself."""
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
                said = "".join(reversed(process.communicate()))
                running.pop(0)
                _check(command, folder, process.returncode, said)
    finally:
        for _, process in running:
            process.communicate()


def _start(command: list[str], folder: Path, tied_to: int) -> subprocess.Popen[str]:
    pipe = subprocess.PIPE
    # What a killed compiler leaves goes with the folder that it was to write into.
    beside = (folder / command[command.index("-o") + 1]).absolute().parent
    try:
        return subprocess.Popen(
            ["sh", "-c", _GUARD, "sh", *command], cwd=folder, stdin=tied_to, stdout=pipe, stderr=pipe, text=True,
            errors="replace", start_new_session=True, env=os.environ | {"TMPDIR": str(beside)},
        )  # fmt: skip
    except OSError as error:
        raise CompilerError(f"{error.strerror} ({shlex.join(command)})", where="C compiler", hint="set CC") from None


def _check(command: list[str], folder: Path, code: int, output: str) -> None:
    """Refuse what failed: ``output`` is standard error, then standard output."""
    if code == 0 and (folder / command[command.index("-o") + 1]).is_file():
        return
    said = [line for line in output.splitlines() if line.strip()]
    first = next((line for line in said if "error" in line.lower()), said[0] if said else None)
    raise CompilerError(
        f"{first or f'it said nothing, exit code {code}'} (command: {shlex.join(command)}, in {folder})",
        where="the C compiler failed",
        hint="check the compiler or set CC to another",
    )
