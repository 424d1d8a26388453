"""The user's C compiler: found once, called one way."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from pathlib import Path

from impact_posture.errors import CompilerError


def find_compiler() -> list[str] | None:
    """The C compiler as the head of a command: ``$CC`` (which may carry options), cc, gcc or clang; else ``None``."""
    for text in (os.environ.get("CC", ""), "cc", "gcc", "clang"):
        words = shlex.split(text)
        if words and shutil.which(words[0]):
            return words
    return None


def run_compiler(command: list[str], folder: Path) -> None:
    """Run a compiler's command in ``folder``.

    Raises:
        CompilerError: With the compiler's first error line and the command.
    """
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, errors="replace", check=False)
    except OSError as error:
        raise CompilerError(f"{error.strerror} ({shlex.join(command)})", where="C compiler", mend="set CC") from None
    output = Path(command[command.index("-o") + 1])
    if done.returncode == 0 and (folder / output).is_file():
        return
    said = [line for line in (done.stderr + done.stdout).splitlines() if line.strip()]
    first = next((line for line in said if "error" in line.lower()), said[0] if said else None)
    raise CompilerError(
        f"{first or f'it said nothing, exit code {done.returncode}'} (command: {shlex.join(command)}, in {folder})",
        where="the C compiler failed",
        mend="check the compiler or set CC to another",
    )
