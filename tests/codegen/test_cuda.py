"""The CUDA export: as C++ it equals the C export, nvcc compiles it without warnings, and it runs on a GPU."""

from __future__ import annotations

import ctypes
import subprocess
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from impact_posture.codegen.c_literals import DOUBLE, FLOAT, Real
from impact_posture.codegen.compile_and_check import deviation, largest_difference
from impact_posture.codegen.export import Export, export, write_export
from impact_posture.codegen.export_functions import SIGNATURES
from impact_posture.codegen.export_library import NamedObjective, export_library
from impact_posture.codegen.expression_graph import Graph
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.limb_order import limb_of_coordinates, limb_of_joints, limbs_of_nodes, order_by_limb
from impact_posture.codegen.limb_warps import LANES, lay_out_warps, schedule
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
# kernel.  Kernels with barriers run on real threads.
WORDS = """
#include <barrier>
#include <cmath>
#include <cstddef>
#include <thread>
#include <vector>
#define __device__
#define __global__
#define __constant__
#define __noinline__
#define __forceinline__ inline
#define __launch_bounds__(...)
#define __shared__ static
#define THREADS 128
static thread_local struct { size_t x; } blockIdx, threadIdx, gridDim;
static std::barrier<> barrier(THREADS);
#define GPU_BARRIER() barrier.arrive_and_wait()
template <typename Kernel> void run(size_t blocks, size_t threads, Kernel kernel)
{
  for (size_t block = 0; block < blocks; ++block) {
    const auto thread = [=](size_t index) {
      blockIdx.x = block;
      threadIdx.x = index;
      gridDim.x = blocks;
      kernel();
    };
    std::vector<std::thread> others;
    for (size_t index = 1; index < threads; ++index) {
      others.emplace_back(thread, index);
    }
    thread(0);
    for (auto &other : others) {
      other.join();
    }
  }
}
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
    by_warps = f"_ROWS {LANES}" in (written.out / f"{prefix}.cuh").read_text()
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
        # One block computes all rows; a kernel without barriers needs only one thread.
        threads = "THREADS" if by_warps else "1"
        call = f"device::{function}_kernel<{threads}>({', '.join(['q', *normals, 'count', *results])}, nullptr)"
        lines.append(f"""
int {symbol}({", ".join(arrays)})
{{
  run(1, {threads}, [=] {{ {call}; }});
  return 0;
}}""")
        if normals:
            # More threads than rows; the last threads must not write anything.
            threads = "THREADS" if by_warps else "2"
            lines.append(f"""
void {function}_rows(const {real} *q, const {real} *n, int count, {real} *H, {real} *grad, int *status)
{{
  run(2, {threads}, [=] {{ device::{function}_kernel<{threads}>(q, n, 1, count, H, grad, status); }});
}}""")
    (written.out / "host.cpp").write_text("\n".join([*lines, "}"]))
    run_compiler(
        [*compiler, "-std=c++20", "-O0", "-pthread", *STRICT, "-fPIC", "-shared", "host.cpp", "-o", "host.so"],
        written.out,
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


@pytest.mark.parametrize("name", [pytest.param("tilthex_arm"), pytest.param("talos")])
def test_status_of_each_row(name: str, tmp_path: Path) -> None:
    robot, count = load_robot(name), 3 * LANES + 1
    objective = WorstCaseObjective(robot, ImpactContact(robot.spec.contact.frame, (0, 0.6, 0.8)))
    written = export(objective, tmp_path, prefix="gpu", cuda=True, check=False)
    library, nv = on_host(written, [objective]), robot.nv
    gradient = ImpactGradient(library, written.manifest)
    q = np.resize(np.stack([*sample_postures(robot, 3, 1)]), (count, robot.nq))
    q[0, 0], q[1, 3:7] = np.nan, 0.0
    n, H, grad = np.array([0.0, 0.6, 0.8]), np.zeros(count + 1), np.zeros((count + 1, nv))
    status = np.full(count + 1, -1, dtype=np.int32)
    pointers = [ctypes.c_void_p(a.ctypes.data) for a in (q, n, H, grad, status)]
    library.gpu_eval_rows(*pointers[:2], count, *pointers[2:])
    assert status.tolist() == [1, 2, *[0] * (count - 2), -1]
    assert np.isnan(H[:2]).all() and np.isnan(grad[:2]).all()
    assert H[count] == 0 and not grad[count].any()
    value, row = gradient.value_and_gradient(q[2], n)
    for k in range(2, count, 3):
        # Both functions compute the same expressions, but a compiler may round them differently.
        assert deviation(H[k : k + 1], np.array([value])).error <= 1e-13
        assert deviation(grad[k], row).error <= 1e-13


def test_float_with_supports_is_refused(tmp_path: Path) -> None:
    robot = load_robot("solo8")
    standing = WorstCaseObjective(robot, ImpactContact("base_link", (0, 0, 1)), supports=robot.spec.supports)
    with pytest.raises(InputError, match="1e-2 on a GPU"):
        write_export([standing], tmp_path / "out", single=True, cuda=True)
    assert not (tmp_path / "out").exists()
    assert write_export([replace(standing, supports=())], tmp_path / "out", single=True, cuda=True).files


def limbs_of(name: str) -> tuple[Graph, list[str], dict[int, int]]:
    """Return the graph of the objective H of a robot, its outputs, and node → limb."""
    robot = load_robot(name)
    objective = WorstCaseObjective(robot, ImpactContact(robot.spec.contact.frame, (0, 0, 1)))
    library = export_library([NamedObjective(objective, "x")], lean=True)
    graph, (function, *_), of_joint = library.graph(), library.functions, limb_of_joints(robot.model)
    visits = [(k, of_joint[j]) for k, j in zip(graph.outputs["visits"], library.joints, strict=True)]
    outputs = [*function.outputs]
    return graph, outputs, limbs_of_nodes(graph, outputs, visits, limb_of_coordinates(robot.model))


def test_order_by_limb() -> None:
    # The head, two legs, two arms with grippers; base and torso are the body.
    counts = Counter(limb_of_coordinates(load_robot("talos").model).values())
    assert sorted(counts.values()) == [2, 6, 6, 8, 8, 7 + 2]
    graph, _, limbs = limbs_of("talos")
    order = order_by_limb(graph, limbs)
    place = {k: i for i, k in enumerate(order)}
    assert all(place[a] < place[k] for k in limbs for a in graph.nodes[k].operands)


@pytest.mark.parametrize("name", ["talos", "solo8", "anymal_kinova"])
def test_warps_exchange_values_only_between_stages(name: str) -> None:
    graph, outputs, limbs = limbs_of(name)
    plan = schedule(graph, limbs)
    layout = lay_out_warps(graph, outputs, plan)
    home = {k: (plan.stages[b.nodes[0]], plan.warps[b.nodes[0]]) for b in layout.blocks for k in b.nodes}
    last: dict[int, int] = {}
    for k in limbs:
        for a in graph.nodes[k].operands:
            if a in limbs:
                alike = plan.warps[a] == plan.warps[k]
                assert plan.stages[a] < plan.stages[k] + alike
                # Other warps, and later stages, read the value from an array.
                if plan.stages[a] < plan.stages[k]:
                    assert a in layout.slots and (alike or a in layout.shared)
                last[a] = max(last.get(a, 0), plan.stages[k])
    results = {k for output in outputs for k in graph.outputs[output]}
    held: dict[tuple[bool, int], list[tuple[int, int]]] = {}
    for k, slot in layout.slots.items():
        end = plan.count if k in results else last[k]
        held.setdefault((k in layout.shared, slot), []).append((home[k][0], end))
    for spans in held.values():
        spans.sort()
        # A value may replace another value only in a stage after the last stage that uses the other value.
        assert all(end < start for (_, end), (start, _) in pairwise(spans))


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
