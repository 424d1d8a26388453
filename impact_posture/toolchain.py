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
            f"{text!r} cannot be split into words ({str(error).lower()})", where=variable, mend="close the quote"
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
    try:
        while waiting or running:
            while waiting and len(running) < (os.cpu_count() or 1):
                command = waiting.pop(0)
                running.append((command, _start(command, folder)))
            command, process = running[0]
            said = "".join(reversed(process.communicate()))
            running.pop(0)
            _check(command, folder, process.returncode, said)
    finally:
        # After an error or Ctrl-C: none is left behind, nor what it has started itself.
        for _, process in running:
            _kill(process)


def _kill(process: subprocess.Popen[str]) -> None:
    with suppress(ProcessLookupError):
        if hasattr(os, "killpg"):
            os.killpg(process.pid, signal.SIGKILL)
        else:
            process.kill()
    process.communicate()


def _start(command: list[str], folder: Path) -> subprocess.Popen[str]:
    pipe = subprocess.PIPE
    try:
        # In a session of its own, as a whole to be killed: a compiler is several processes.
        return subprocess.Popen(
            command, cwd=folder, stdout=pipe, stderr=pipe, text=True, errors="replace", start_new_session=True
        )
    except OSError as error:
        raise CompilerError(f"{error.strerror} ({shlex.join(command)})", where="C compiler", mend="set CC") from None


def _check(command: list[str], folder: Path, code: int, output: str) -> None:
    """Refuse what failed: ``output`` is standard error, then standard output."""
    if code == 0 and (folder / command[command.index("-o") + 1]).is_file():
        return
    said = [line for line in output.splitlines() if line.strip()]
    first = next((line for line in said if "error" in line.lower()), said[0] if said else None)
    raise CompilerError(
        f"{first or f'it said nothing, exit code {code}'} (command: {shlex.join(command)}, in {folder})",
        where="the C compiler failed",
        mend="check the compiler or set CC to another",
    )
