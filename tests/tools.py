"""Tools that a test may need and a machine may lack: the test then skips and names the tool."""

from __future__ import annotations

import shutil

import pytest

from impact_posture.toolchain import find_compiler


def need_compiler() -> list[str]:
    compiler = find_compiler()
    if compiler is None:
        pytest.skip("no C compiler (cc, gcc, clang)")
    return compiler


def need(tool: str) -> str:
    path = shutil.which(tool)
    if path is None:
        pytest.skip(f"no {tool}")
    return path
