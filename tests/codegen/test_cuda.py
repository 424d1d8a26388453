"""The CUDA export: as C++ it equals the C export, nvcc compiles it without warnings, and it runs on a GPU."""

from __future__ import annotations

import ctypes
import subprocess
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.codegen.block_layout import lay_out
from impact_posture.codegen.c_literals import DOUBLE, FLOAT, Real
from impact_posture.codegen.compile_and_check import deviation, largest_difference
from impact_posture.codegen.export import Export, export, write_export
from impact_posture.codegen.export_functions import SIGNATURES
from impact_posture.codegen.export_library import NamedObjective, export_library
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.limb_order import limb_of_coordinates, order_by_limb
from impact_posture.codegen.self_test import casadi_reference, sample_postures, self_test_tolerance
from impact_posture.errors import InputError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.toolchain import run_compiler
from tests.support import command
from tests.support.tools import STRICT, cxx_compiler, need, need_compiler

# The words of CUDA that a C++ compiler does not know.  The program sets the index of a thread before it calls a
# kernel.
WORDS = """
#include <cmath>
#include <cstddef>
#define __device__
#define __global__
#define __constant__
#define __noinline__
#define __forceinline__ inline
#define __launch_bounds__(...)
static struct { size_t x; } blockIdx, threadIdx, gridDim;
using std::isfinite;
inline void sincosf_(float angle, float *sine, float *cosine) { *sine = sinf(angle); *cosine = cosf(angle); }
#define sincosf sincosf_
"""


def on_host(written: Export, objectives: list[WorstCaseObjective]) -> ctypes.CDLL:
    """Compile the device code as C++.  The names are as in the C export, and the batch function calls the kernel."""
    compiler = cxx_compiler()
    if compiler is None:
        pytest.skip("no C++ compiler")
    prefix, real = written.prefix, written.manifest["real"]
    lines = [WORDS, "namespace device {", f'#include "{written.out / prefix}.cuh"', "}", 'extern "C" {']
    for symbol in written.functions:
        function = symbol.removesuffix("_batch")
        name = function.rpartition("_")[2]
        inputs, results = SIGNATURES[name]
        arrays = [f"const {real} *{v}" for v in inputs] + [f"{real} *{v}" for v in results]
        if function == symbol:
            call = f"device::{symbol}({', '.join(inputs + results)})"
            lines.append(f"int {symbol}({', '.join(arrays)}) {{ return {call}; }}")
            continue
        arrays.insert(len(inputs), "int count")
        normals = ["n", "count"] if "n" in inputs else []
        lines.append(f"""
int {symbol}({", ".join(arrays)})
{{
  // One block of one thread computes all rows.
  blockIdx.x = threadIdx.x = 0;
  gridDim.x = 1;
  device::{function}_kernel<1>({", ".join(["q", *normals, "count", *results])}, nullptr);
  return 0;
}}""")
        if normals:
            lines.append(f"""
void {function}_rows(const {real} *q, const {real} *n, int count, {real} *H, {real} *grad, int *status)
{{
  // More threads than rows; the last threads must not write anything.
  gridDim.x = 2;
  for (blockIdx.x = 0; blockIdx.x < 2; ++blockIdx.x) {{
    for (threadIdx.x = 0; threadIdx.x < 2; ++threadIdx.x) {{
      device::{function}_kernel<2>(q, n, 1, count, H, grad, status);
    }}
  }}
}}""")
    (written.out / "host.cpp").write_text("\n".join([*lines, "}"]))
    run_compiler(
        [*compiler, "-std=c++17", "-O0", *STRICT, "-fPIC", "-shared", "host.cpp", "-o", "host.so"], written.out
    )
    return ctypes.CDLL(str(written.out / "host.so"))


def bound(library: ctypes.CDLL, written: Export) -> list[ImpactGradient]:
    """Bind the functions of all frames, with and without supports."""
    manifest = written.manifest
    frames = [block["frame"] for block in manifest["frames"]]
    return [ImpactGradient(library, manifest, f, free=free) for f in frames for free in (False, True)]


CASES: dict[str, tuple[str, tuple[str, ...], dict[str, Any], Real]] = {
    "impulse, two frames": ("tilthex_arm", ("ee", "base_link"), {}, DOUBLE),
    "speed in float": ("tilthex_arm", ("ee",), {"kind": "speed"}, FLOAT),
    "sticking": ("panda", ("panda_hand_tcp",), {"kind": "sticking", "metric": Metric("kinetic")}, DOUBLE),
    "energy": ("panda", ("panda_hand_tcp",), {"kind": "energy"}, DOUBLE),
    "coulomb with feet": ("solo8", ("base_link",), {"kind": "coulomb"}, DOUBLE),
    "cone": ("tilthex_arm", ("ee",), {"normal_cone_deg": 20.0}, DOUBLE),
    "not inlined": ("talos", ("gripper_right_base_link",), {}, DOUBLE),
}


@pytest.mark.long(but=("impulse, two frames", "speed in float", "coulomb with feet", "cone", "sticking"))
@pytest.mark.parametrize("case", list(CASES))
def test_equals_the_c_export(case: str, tmp_path: Path) -> None:
    need_compiler()
    name, frames, options, real = CASES[case]
    robot = load_robot(name)
    supports = robot.spec.supports if "feet" in case else ()
    objectives = [
        WorstCaseObjective(
            robot, ImpactContact(frame, (1.0, 0.3, -0.2), (0.01, 0.02, 0.0)), supports=supports, **options
        )
        for frame in frames
    ]
    written = export(objectives, tmp_path, prefix="gpu", real=real, cuda=True, check=False)
    assert ("__noinline__" in (tmp_path / "gpu.cuh").read_text()) == ("not inlined" in case)
    device = bound(on_host(written, objectives), written)
    host = bound(ImpactGradient.load(tmp_path)._library, written)
    # With supports, the rounding differences are larger, because the feet are stiff.
    tolerance = 3e-4 if real is FLOAT else 1e-9 if supports else 1e-12
    for ours, reference in zip(device, host, strict=True):
        for q in sample_postures(robot, 5, 3):
            n = np.array([0.6, 0.0, -0.8])
            for function in SIGNATURES:
                code, results = ours.call(function, q, n)
                expected_code, expected = reference.call(function, q, n)
                assert code == expected_code == 0
                for result, value in zip(results, expected, strict=True):
                    assert deviation(result.astype(float), value.astype(float)).error <= tolerance, (case, function)
    assert largest_difference(device[0], objectives[0], casadi_reference, 3) <= self_test_tolerance(
        objectives[0], real
    )


def test_several_contacts(tmp_path: Path) -> None:
    need_compiler()
    robot = load_robot("tilthex_arm")
    contacts = ImpactContact("ee", (0.0, 0.0, 1.0)), ImpactContact("base_link", (1.0, 0.0, 0.0), impulse=0.5)
    objective = WorstCaseObjective(robot, contacts[0], others=contacts[1:])
    written = export(objective, tmp_path, prefix="gpu", cuda=True, check=False)
    gradient = ImpactGradient(on_host(written, [objective]), written.manifest)
    assert largest_difference(gradient, objective, casadi_reference, 5) <= 1e-11


def test_status_of_each_row(tmp_path: Path) -> None:
    arm = WorstCaseObjective(load_robot("tilthex_arm"), ImpactContact("ee", (0, 0.6, 0.8)))
    written = export(arm, tmp_path, prefix="gpu", cuda=True, check=False)
    library = on_host(written, [arm])
    gradient, nv = ImpactGradient(library, written.manifest), arm.robot.nv
    q = np.stack([*sample_postures(arm.robot, 3, 1)])
    q[0, 0], q[1, 3:7] = np.nan, 0.0
    n, H, grad, status = np.array([0.0, 0.6, 0.8]), np.zeros(3), np.zeros((3, nv)), np.full(3, -1, dtype=np.int32)
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (q, n, H, grad, status)]
    library.gpu_eval_rows(*pointers[:2], 3, *pointers[2:])
    assert status.tolist() == [1, 2, 0]
    assert np.isnan(H[:2]).all() and np.isnan(grad[:2]).all()
    value, row = gradient.value_and_gradient(q[2], n)
    assert H[2] == value and grad[2].tolist() == row.tolist()


def test_float_with_supports_is_refused(tmp_path: Path) -> None:
    robot = load_robot("solo8")
    standing = WorstCaseObjective(robot, ImpactContact("base_link", (0, 0, 1)), supports=robot.spec.supports)
    with pytest.raises(InputError, match="1e-2 on a GPU"):
        write_export([standing], tmp_path / "out", single=True, cuda=True)
    assert not (tmp_path / "out").exists()
    assert write_export([replace(standing, supports=())], tmp_path / "out", single=True, cuda=True).files


def test_order_by_limb_keeps_fewer_values() -> None:
    robot = load_robot("talos")
    limbs = limb_of_coordinates(robot.model)
    # The head, two legs, two arms with grippers; base and torso are the body.
    assert sorted(Counter(limbs.values()).values()) == [2, 6, 6, 8, 8, 7 + 2]
    objective = WorstCaseObjective(robot, ImpactContact("gripper_right_base_link", (0, 0, 1)))
    library = export_library([NamedObjective(objective, "x")])
    graph, (function, *_) = library.graph(), library.functions
    order = order_by_limb(graph, function.outputs, limbs)
    place = {k: i for i, k in enumerate(order)}
    assert all(place[a] < place[k] for k in order for a in graph.nodes[k].operands)
    kept = [lay_out(graph, [function.outputs], 300, ordered).sizes[1] for ordered in (order, ())]
    assert kept[0] < kept[1]


# ---- nvcc and a GPU -----------------------------------------------------------------------------------------------


def test_nvcc_compiles_it_and_a_gpu_runs_it(tmp_path: Path) -> None:
    nvcc = need("nvcc")
    out = tmp_path / "arm"
    line = ["codegen", "tilthex_arm", "--frame", "ee", "--normal", "0", "0.6", "0.8", "--prefix", "arm", "--cuda"]
    command.run(*line, "--out", str(out))
    targets = [f"-gencode=arch=compute_{k},code=sm_{k}" for k in (80, 90)]
    build = [nvcc, "-std=c++17", "-Werror", "all-warnings", "-Xcompiler", "-Wall,-Wextra", *targets]
    done = subprocess.run([*build, "example.cu", "-o", "example_cuda"], cwd=out, capture_output=True, text=True)
    assert done.returncode == 0 and "warning" not in done.stderr, done.stderr
    ran = subprocess.run(["./example_cuda"], cwd=out, capture_output=True, text=True)
    if ran.returncode == 77:
        pytest.skip(ran.stdout.strip())
    assert ran.returncode == 0 and ran.stdout.startswith("agrees"), ran.stdout
