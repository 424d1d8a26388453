"""If a controller of another package raises, ends the process or returns rubbish, the error names the controller.

``--hostile-full`` tries all controllers.
"""

from __future__ import annotations

import importlib
import json
import random
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from matplotlib.figure import Figure

import impact_posture.experiment.experiment_folders
from impact_posture.simulation.controllers.controller_factory import GROUP
from tests.hostile.arena import judging, strike, write_short_scenario
from tests.simulation.factories import needs_mujoco

HEAD = """
import os, signal, sys
from dataclasses import replace
import numpy as np
from impact_posture.simulation.controllers.driver import Driver
from impact_posture.simulation.controllers.task_formulations import nominal_posture

class Nominal(Driver):
    def __init__(self, factory):
        super().__init__(factory.setup, nominal_posture(factory.setup))

def changed(**changes):
    class Changed(Nominal):
        def tick(self, reading, reference=None):
            command = super().tick(reading, reference)
            return replace(command, **{key: value(getattr(command, key)) for key, value in changes.items()})
    return lambda factory, mode, gain: Changed(factory)

def with_method(method, call):
    return lambda factory, mode, gain: type("Other", (Nominal,), {method: call})(factory)

def fails(error):
    def fail(*arguments, **named):
        raise error
    return fail
"""
ERRORS = (
    "ValueError('two\\nlines' * 1000)", "SystemExit(0)", "SystemExit('x')", "KeyboardInterrupt()", "GeneratorExit()",
    "MemoryError()", "RecursionError()", "OSError(28, 'No space left')", "BrokenPipeError(32, 'pipe')",
    "AssertionError()", "StopIteration()", "UnicodeDecodeError('utf-8', b'\\xff', 0, 1, 'x')",
)  # fmt: skip
METHODS = ("reset", "tick", "brace", "lead", "expect")
RUBBISH = ("None", "1", "'text'", "[1, 2]", "object()", "np.zeros(3)", "{}")
LEVELS = ("np.nan", "1e300", "None", "'x'", "np.zeros(3)", "-1")
ARRAYS = ("x * np.nan", "x * 1e300", "x[:-1]", "np.zeros((2, 2))", "None", "'text'", "list(x)", "x + 1j")
STATUSES = ("None", "99", "'SOLVED'")
# Code of each controller: an expression that is called with factory, mode and gain.
CODES = [
    *(f"fails({error})" for error in ERRORS),
    *(f"lambda *a: {rubbish}" for rubbish in RUBBISH),
    *(f"with_method('{method}', fails({error}))" for method in METHODS for error in ERRORS),
    *(f"with_method('{method}', lambda *a: {rubbish})" for method in ("reset", "tick") for rubbish in RUBBISH),
    *(f"changed({key}=lambda x: {value})" for key in ("torque", "rotor_speed", "forces") for value in ARRAYS),
    *(f"changed(status=lambda x: {value})" for value in STATUSES),
    *(f"with_method('level', property(lambda self: {value}))" for value in LEVELS),
    *(f"with_method('level', property(fails({error})))" for error in ERRORS),
    "lambda *a: type('Bare', (Driver,), {'__init__': lambda self: None})()", "lambda: None", "3",
    "lambda factory, *a: (print('noise'), os.write(1, b'noise'), Nominal(factory))[-1]",
    "with_method('tick', lambda *a: (os.kill(os.getpid(), signal.SIGINT), [0 for _ in iter(int, 1)]))",
    "with_method('tick', lambda self, r, p=None: (r.q.fill(np.nan), Nominal.tick(self, r, p))[-1])",
    "lambda factory, *a: (setattr(factory.setup.scenario, 'task', None), Nominal(factory))[-1]",
]  # fmt: skip


@pytest.fixture
def evil(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Install a package with all hostile controllers, and return the names of its entry points."""
    packages = tmp_path / "packages"
    metadata = packages / "evil-1.0.dist-info"
    metadata.mkdir(parents=True)
    lines = [f"c{k} = {code}" for k, code in enumerate(CODES)]
    (packages / "evil.py").write_text("\n".join([HEAD, *lines, ""]), encoding="utf-8")
    for name, text in (("raises", "1 / 0"), ("exits", "import sys; sys.exit(0)"), ("syntax", "def"), ("null", "\0")):
        (packages / f"evil_{name}.py").write_text(text)
    entries = {text: f"evil:c{k}" for k, text in enumerate(CODES)}
    entries |= {f"import {name}": f"evil_{name}:make" for name in ("raises", "exits", "syntax", "null", "gone")}
    entries |= {"no attribute": "evil:nothing", "malformed": "::", "os": "os:_exit"}
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: evil\nVersion: 1.0\n", encoding="utf-8")
    names = [f"e{k} = {value}" for k, value in enumerate(entries.values())]
    (metadata / "entry_points.txt").write_text("\n".join([f"[{GROUP}]", *names]), encoding="utf-8")
    monkeypatch.syspath_prepend(packages)
    importlib.invalidate_caches()
    yield list(entries)
    sys.modules.pop("evil", None)


def test_controllers_of_other_packages(
    evil: list[str], arena: Path, hostile_full: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    needs_mujoco()
    figures = impact_posture.experiment.experiment_folders
    monkeypatch.setattr(figures, "figures_of_run", lambda views: {"snapshots": Figure(figsize=(1, 1))})
    write_short_scenario(arena)
    chosen = range(len(evil)) if hostile_full else random.Random(3).sample(range(len(evil)), 6)
    with judging() as judge:
        for k in chosen:
            shutil.rmtree(arena / "out", ignore_errors=True)
            options = ("--no-report", "--out", "out", "--quiet")
            outcome = strike(arena, "simulate", "short.toml", "--controller", f"e{k}", *options)
            complaints = outcome.complaints
            if outcome.code in (0, 3, 4):
                # A robot that falls has a result, too.
                complaints = [fault for fault in complaints if "fails and leaves" not in fault]
                document = json.loads((arena / "out" / "run.json").read_text(), parse_constant=str)
                complaints += ["NaN in the result"] if "NaN" in str(document) else []
            elif outcome.code != 130 and f"controller 'e{k}'" not in outcome.err and "MemoryError" not in evil[k]:
                complaints.append("does not name the controller")
            judge(f"{evil[k]}: {outcome.code} {outcome.err[-300:]!a}", complaints, 0)
