"""Exported C refuses hostile parameters and inputs, or gives finite numbers within the limits, under sanitizers.

``--hostile-full`` tries forty times as many inputs, with more robots.
"""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from impact_posture.codegen.c_literals import REALS
from impact_posture.codegen.export import export
from tests.hostile.arena import judging
from tests.support.exported_controller import exported, formulation_of, impact_of
from tests.support.struck_paths import write_references
from tests.support.tools import need_compiler

SUPPORT = Path(__file__).parents[1] / "support"
# Robot, contact frame and normal of an exported controller.
CONTROLLERS = {
    "tilthex_arm": ("ee", (0.0, 0.0, 1.0)),
    "panda": ("panda_hand_tcp", (0.0, 0.0, 1.0)),
    "solo8": ("base_link", (1.0, 0.0, 0.0)),
}
METRICS = [
    ("panda", "panda_hand_tcp", "double", 0),
    ("solo8", "base_link", "float", 0),
    ("panda", "panda_hand_tcp", "double", 4),
]


def run_sanitized(folder: Path, program: str, sanitizers: str, out: Path, *words: str) -> str:
    """Build a program of tests/support/ with all sources of an export, and return what it prints."""
    sources = sorted(str(path) for path in folder.glob("*.c") if path.stem not in ("example", "check"))
    flags = [
        f"-fsanitize={sanitizers}",
        "-fno-sanitize-recover=all",
        "-O0",
        "-g0",
        f"-I{folder}",
        f"-isystem{folder}/daqp",
    ]
    command = [*need_compiler(), "-std=gnu99", *flags, str(SUPPORT / program), *sources, "-o", str(out / "program")]
    built = subprocess.run([*command, "-lm", "-lpthread"], capture_output=True, text=True)
    if built.returncode and "sanit" in built.stderr + built.stdout:
        pytest.skip(f"the compiler has no -fsanitize={sanitizers}")
    assert built.returncode == 0, built.stderr
    ran = subprocess.run([out / "program", *words], capture_output=True, text=True)
    if "unexpected memory mapping" in ran.stderr:
        pytest.skip("this kernel places memory where the thread sanitizer does not expect it")
    return "" if ran.returncode == 0 else f"{ran.returncode}: {ran.stdout} {ran.stderr[-1000:]}"


@pytest.mark.parametrize("flow", [False, True], ids=["", "flow"])
@pytest.mark.parametrize("name", CONTROLLERS)
def test_parameters_of_controllers(name: str, flow: bool, tmp_path: Path, hostile_full: bool) -> None:
    if (name, flow) != ("tilthex_arm", False) and not hostile_full:
        pytest.skip("controllers of other robots: give --hostile-full")
    folder = exported(name, impact_of(formulation_of(name)[0], *CONTROLLERS[name]), path=() if flow else None)
    sets = 4000 if hostile_full else 400
    with judging() as judge:
        fault = run_sanitized(
            folder, "controller_parameters.c", "address,undefined,float-cast-overflow", tmp_path, str(sets)
        )
        judge(name, [fault] if fault else [], sets)


@pytest.mark.parametrize(("name", "strikes"), [("panda", True), ("solo8", True), ("solo8", False)])
def test_inputs_of_paths(name: str, strikes: bool, tmp_path: Path, hostile_full: bool) -> None:
    if not strikes and not hostile_full:
        pytest.skip("paths without a strike: give --hostile-full")
    calls = 1_000_000 if hostile_full else 50_000
    with judging() as judge:
        folder = write_references(tmp_path / "path", name, strikes)
        sanitizers = "address,undefined,float-cast-overflow,float-divide-by-zero"
        fault = run_sanitized(folder, "path_inputs.c", sanitizers, tmp_path, str(calls))
        judge(name, [fault] if fault else [], calls)


@pytest.mark.parametrize(("name", "frame", "number", "threads"), METRICS)
def test_inputs_of_metrics(
    name: str, frame: str, number: str, threads: int, tmp_path: Path, hostile_full: bool
) -> None:
    if threads + (number == "float") and not hostile_full:
        pytest.skip("single precision and threads: give --hostile-full")
    objective = impact_of(formulation_of(name)[0], frame, (1.0, 0.0, 0.0))
    (tmp_path / "m").mkdir()
    export(objective, tmp_path / "m", prefix="m", real=REALS[number], check=False)
    sanitizers = "thread" if threads else "address,undefined,float-cast-overflow"
    inputs = 4000 if hostile_full else 100
    with judging() as judge:
        fault = run_sanitized(
            tmp_path / "m", "metric_inputs.c", sanitizers, tmp_path, str(inputs), str(max(1, threads))
        )
        judge(name, [fault] if fault else [], inputs)
