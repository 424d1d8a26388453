"""C and Python compute the same references along a path, and the exported example follows these references."""

from __future__ import annotations

import ctypes
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from impact_posture.controller_export.controller_structure import structure_of
from impact_posture.controller_export.path_source import render_path
from impact_posture.errors import InputError
from impact_posture.path.path_reference import PathPhase, PathReference
from impact_posture.system.arrays import Array
from impact_posture.system.libraries import library_path
from tests.support.exported_controller import exported, formulation_of
from tests.support.struck_paths import reference_of, write_references
from tests.support.tools import STRICT, need_compiler

KEPT = TemporaryDirectory()
PERIOD = 1e-3


@cache
def library_of(name: str, strikes: bool, rest: float) -> ctypes.CDLL:
    folder = write_references(Path(KEPT.name) / f"{name}-{strikes}-{rest}", name, strikes, rest=rest)
    command = [*need_compiler(), "-std=c99", *STRICT, "-Wconversion", "-O1", "-shared", "-fPIC", "ctl_path.c"]
    subprocess.run([*command, "-o", "path.so", "-lm"], cwd=folder, check=True)
    return ctypes.CDLL(str(folder / "path.so"))


class PathInC:
    """References of a robot in C, with the methods of ``PathReference``."""

    def __init__(self, name: str, strikes: bool = True, rest: float = 0.25) -> None:
        robot, doubles = formulation_of(name)[0], ctypes.c_double
        sizes = {"q": robot.nq, "v": robot.nv, "a": robot.nv, "late": 1, "felt": 1, "stopped": 1, "lag": 1}
        memory = {"phase": ctypes.c_int, "memory": doubles * (5 * robot.nv + 2 * robot.nq + 9)}
        fields = [*((key, doubles * size) for key, size in sizes.items()), *memory.items()]
        self.block = type("Path", (ctypes.Structure,), {"_fields_": fields})()
        self._library = library_of(name, strikes, rest)
        self._call("init")

    def _call(self, name: str, *arguments: Any) -> int:
        return int(getattr(self._library, f"ctl_path_{name}")(ctypes.byref(self.block), *arguments))

    def start(self, t: float, contact: float = -np.inf) -> int:
        return self._call("start", ctypes.c_double(t), ctypes.c_double(contact))

    def expect(self, contact: float) -> int:
        return self._call("expect", ctypes.c_double(contact))

    def back(self, over: float) -> int:
        return self._call("return", ctypes.c_double(over))

    def tick(self, t: float, q: Array, v: Array, force: float | None = None) -> None:
        felt = ctypes.c_double(np.nan if force is None else force)
        pointers = [np.ascontiguousarray(x).ctypes.data_as(ctypes.c_void_p) for x in (q, v)]
        self._call("tick", ctypes.c_double(t), *pointers, felt)


Call = Callable[[PathReference | PathInC], object]


def phases(
    name: str,
    calls: dict[int, Call],
    force: dict[int, float] | None = None,
    *,
    stopped: float = 0.0,
    n: int = 700,
    strikes: bool = True,
    rest: float = 0.25,
) -> dict[int, PathPhase]:
    """Make the same calls in Python and in C at the same ticks, and compare the references of all ticks.

    The robot is not at its reference, and has 30 % of the velocity of the reference.  Return the ticks at which a
    phase begins.
    """
    python, c, begun = reference_of(name, strikes, rest=rest), PathInC(name, strikes, rest), dict[int, PathPhase]()
    python.reset()
    python.stopped = c.block.stopped[0] = stopped
    model, rng, before = python.path.model, np.random.default_rng(1), PathPhase.IDLE
    for k in range(n):
        for path in (python, c) if k in calls else ():
            calls[k](path)
        q = np.array(pin.integrate(model, python.moment[0], 0.01 * rng.normal(size=model.nv)))
        v = 0.3 * python.moment[1]
        for path in (python, c):
            path.tick(k * PERIOD, q, v, (force or {}).get(k))
        for wanted, have, size in zip(python.moment, (c.block.q, c.block.v, c.block.a), (1, 20, 1e3), strict=True):
            np.testing.assert_allclose(np.array(have), wanted, rtol=0, atol=1e-11 * size, err_msg=f"tick {k}")
        assert c.block.phase == python.phase, k
        if python.phase != before:
            begun[k] = before = python.phase
    return begun


def start(path: PathReference | PathInC) -> None:
    path.start(0.0)


BEGIN = {0: PathPhase.APPROACH, 250: PathPhase.RUN_UP}


@pytest.mark.long(but=("solo8",))
@pytest.mark.parametrize("name", ["panda", "solo8"])
def test_a_felt_contact_begins_the_stop(name: str) -> None:
    after = PathPhase.FOLLOW_THROUGH, PathPhase.HOLD
    early = phases(name, {0: start}, {240: 60.0, 349: 4.9, 350: 5.1})
    assert early == BEGIN | dict(zip((350, 550), after, strict=True))
    late = phases(name, {0: start}, {450: 60.0})
    assert late == BEGIN | {401: PathPhase.LATE} | dict(zip((450, 650), after, strict=True))


@pytest.mark.parametrize("name", ["panda", "solo8"])
def test_the_stop_begins_after_a_late_or_stopped_contact(name: str) -> None:
    late = {401: PathPhase.LATE, 476: PathPhase.FOLLOW_THROUGH, 676: PathPhase.HOLD}
    assert phases(name, {0: start}) == BEGIN | late
    (_, _, (hit, third), (_, last)) = phases(name, {0: start}, stopped=0.5).items()
    assert (third, last) == (PathPhase.FOLLOW_THROUGH, PathPhase.HOLD) and 250 < hit <= 400


@pytest.mark.parametrize("name", ["panda", "solo8"])
def test_a_strike_waits_and_is_repeated(name: str) -> None:
    calls: dict[int, Call] = {
        0: lambda path: path.start(0.0, np.inf),
        300: lambda path: path.expect(0.5),
        720: lambda path: path.back(0.1),
        760: lambda path: path.expect(0.8),
    }
    begun = phases(name, calls, {480: 60.0}, n=960)
    first = {0: PathPhase.APPROACH, 350: PathPhase.RUN_UP, 480: PathPhase.FOLLOW_THROUGH, 680: PathPhase.HOLD}
    # The return begins at the last tick, so it ends after 0.819 s.
    assert begun == first | {720: PathPhase.APPROACH, 819: PathPhase.RUN_UP}


@pytest.mark.parametrize("name", ["panda", "solo8"])
def test_a_strike_in_one_piece_waits_at_the_start_and_is_repeated_from_rest(name: str) -> None:
    calls: dict[int, Call] = {
        0: lambda path: path.start(0.0, np.inf),
        100: lambda path: path.expect(0.6),
        # The motion has begun, so the expected contact cannot change.
        300: lambda path: path.expect(0.9),
        820: lambda path: path.back(0.1),
        850: lambda path: path.expect(1.05),
    }
    # A force before the run-up is not the contact.
    begun = phases(name, calls, {300: 60.0, 580: 60.0}, n=1100, rest=0.0)
    first = {0: PathPhase.APPROACH, 450: PathPhase.RUN_UP, 580: PathPhase.FOLLOW_THROUGH, 780: PathPhase.HOLD}
    assert begun == first | {820: PathPhase.APPROACH, 950: PathPhase.RUN_UP, 1051: PathPhase.LATE}


def test_a_path_without_strike_ends_at_rest() -> None:
    calls: dict[int, Call] = {0: start, 100: lambda path: path.expect(0.2), 200: lambda path: path.back(0.1)}
    begun = phases("solo8", calls, {300: 60.0}, n=500, strikes=False)
    assert begun == {0: PathPhase.APPROACH, 400: PathPhase.HOLD}


def test_invalid_calls_change_nothing() -> None:
    path, rest = PathInC("panda"), np.zeros(9)
    path.tick(0.1, rest, rest)
    assert path.block.phase == PathPhase.IDLE and path.expect(1.0) == 1 and path.back(1.0) == 1
    assert [path.start(*times) for times in ((np.nan, 1.0), (np.inf, 1.0), (0.0, np.nan))] == [1, 1, 1]
    path.block.late[0] = np.nan
    assert path.start(0.0) == 1
    path.block.late[0] = 0.01
    assert path.start(0.0) == 0 and path.expect(np.nan) == 1
    path.tick(0.1, rest, rest)
    before = np.array(path.block.q)
    path.tick(np.nan, rest, rest, np.inf)
    np.testing.assert_array_equal(np.array(path.block.q), before)
    # The measured posture of a late contact is invalid, so the references continue from their own posture.
    path.tick(0.5, np.full(9, np.nan), np.full(9, np.nan))
    assert path.block.phase == PathPhase.FOLLOW_THROUGH and np.isfinite(np.array(path.block.q)).all()


def test_paths_that_do_not_fit_are_refused() -> None:
    structure = structure_of(*formulation_of("panda"))
    with pytest.raises(InputError, match="not have the joints of panda"):
        render_path(structure, reference_of("solo8"), "ctl")
    path = reference_of("panda", False).path
    still = type(path)(**vars(path) | {"t": path.t[:1], "q": path.q[:1], "v": path.v[:1], "a": path.a[:1]})
    with pytest.raises(InputError, match="has no motion"):
        render_path(structure, PathReference(still), "ctl")


@pytest.mark.parametrize("strikes", [True, False])
def test_the_example_follows_the_path(strikes: bool, tmp_path: Path) -> None:
    folder, library = (
        write_references(tmp_path / "path", "panda", strikes, 0.02),
        library_path(exported("panda"), "ctl"),
    )
    sources = ["example.c", "ctl_path.c", str(library), f"-Wl,-rpath,{library.parent}"]
    subprocess.run([*need_compiler(), "-std=c99", *STRICT, *sources, "-o", "example", "-lm"], cwd=folder, check=True)
    printed = subprocess.run([folder / "example"], check=True, capture_output=True, text=True).stdout
    begun = [line.rpartition(" ")[2] for line in printed.splitlines()]
    assert begun == (["1", "2", "3", "4", "5"] if strikes else ["1", "5"])
