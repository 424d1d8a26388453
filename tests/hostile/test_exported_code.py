"""Exported C refuses hostile parameters and inputs, or gives finite numbers within the limits, under sanitizers.

``--hostile-full`` tries forty times as many inputs, with more robots, and inputs of libFuzzer.
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
from tests.support.tools import need, need_compiler

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


def run_sanitized(folder: Path, program: str, sanitizers: str, out: Path, *words: str, fuzz: str = "") -> str:
    """Build a program of tests/support/ with all sources of an export, and return its complaint.

    With ``fuzz``, libFuzzer calls the program with this argument, and the words are options of libFuzzer.
    """
    sources = [
        str(SUPPORT / program),
        *sorted(str(p) for p in folder.glob("*.c") if p.stem not in ("example", "check")),
    ]
    compiler = need_compiler()
    flags = [f"-fsanitize={sanitizers}", "-fno-sanitize-recover=all", "-O0", "-g0"]
    if fuzz:
        compiler, sources = [need("clang")], [str(SUPPORT / "fuzzer.c"), *sources]
        flags = [f"-fsanitize=fuzzer,{sanitizers}", *flags[1:], "-Dmain=program", f'-DINPUTS="{fuzz}"']
    flags += [f"-I{folder}", f"-isystem{folder}/daqp"]
    command = [*compiler, "-std=gnu99", *flags, *sources, "-o", str(out / "program")]
    built = subprocess.run([*command, "-lm", "-lpthread"], capture_output=True, text=True)
    if built.returncode and any(word in built.stderr + built.stdout for word in ("sanit", "libclang_rt")):
        pytest.skip(f"the compiler has no {flags[0]}")
    assert built.returncode == 0, built.stderr
    ran = subprocess.run([out / "program", *words], capture_output=True, text=True, cwd=out)
    if "unexpected memory mapping" in ran.stderr:
        pytest.skip("this kernel places memory where the thread sanitizer does not expect it")
    return "" if ran.returncode == 0 else f"{ran.returncode}: {ran.stdout} {ran.stderr[-1000:]}"


@pytest.mark.long
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


def write_metric(place: Path, name: str, frame: str, number: str) -> Path:
    (place / "m").mkdir()
    objective = impact_of(formulation_of(name)[0], frame, (1.0, 0.0, 0.0))
    export(objective, place / "m", prefix="m", real=REALS[number], check=False)
    return place / "m"


@pytest.mark.parametrize(("name", "frame", "number", "threads"), METRICS)
def test_inputs_of_metrics(
    name: str, frame: str, number: str, threads: int, tmp_path: Path, hostile_full: bool
) -> None:
    if threads + (number == "float") and not hostile_full:
        pytest.skip("single precision and threads: give --hostile-full")
    folder = write_metric(tmp_path, name, frame, number)
    sanitizers = "thread" if threads else "address,undefined,float-cast-overflow"
    inputs = 4000 if hostile_full else 100
    with judging() as judge:
        fault = run_sanitized(folder, "metric_inputs.c", sanitizers, tmp_path, str(inputs), str(max(1, threads)))
        judge(name, [fault] if fault else [], inputs)


@pytest.mark.parametrize(
    ("program", "inputs", "runs"),
    [("metric_inputs.c", 1, 4000), ("path_inputs.c", 100, 4000), ("controller_parameters.c", 1, 1000)],
)
def test_inputs_of_libfuzzer(program: str, inputs: int, runs: int, tmp_path: Path, hostile_full: bool) -> None:
    """Try inputs that libFuzzer changes until they reach more branches of the exported code."""
    if not hostile_full:
        pytest.skip("inputs of libFuzzer: give --hostile-full")
    if program == "metric_inputs.c":
        folder = write_metric(tmp_path, *METRICS[0][:3])
    elif program == "path_inputs.c":
        folder = write_references(tmp_path / "path", "solo8")
    else:
        folder = exported("tilthex_arm", impact_of(formulation_of("tilthex_arm")[0], *CONTROLLERS["tilthex_arm"]))
    options = (f"-runs={runs}", "-seed=1", "-max_len=1024", "-len_control=0", "-close_fd_mask=1")
    with judging() as judge:
        sanitizers = "address,undefined,float-cast-overflow"
        fault = run_sanitized(folder, program, sanitizers, tmp_path, *options, fuzz=str(inputs))
        judge(program, [fault] if fault else [], runs)
