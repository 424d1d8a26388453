"""Import packages of the extras, which may be absent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from typing import Any

from impact_posture.errors import InputError


def import_extra(module: str, extra: str = "", name: str = "") -> Any:
    """Return a module; raise InputError with the pip command if its package (``name``) is not installed.

    ``extra`` is the extra of this package that installs the module; empty if there is none.
    """
    try:
        return import_module(module)
    except ImportError:
        hint = f"pip install 'impact-posture[{extra}]'" if extra else f"pip install {module}"
        where = f"the extra '{extra}'" if extra else "import"
        raise InputError(f"{name or module} is not installed", where=where, hint=hint) from None


def import_mujoco() -> Any:
    """Return the module ``mujoco``; raise InputError if MuJoCo is not installed."""
    return import_extra("mujoco", "sim", "MuJoCo")


@contextmanager
def unwarned() -> Iterator[None]:
    """Prevent MuJoCo from writing warnings to a log file in the working directory."""
    mujoco = import_mujoco()
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
