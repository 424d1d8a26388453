"""Build and time the cases that ``prepare.py`` wrote: ``run.py [--build ARCHITECTURE] [--only TEXT]``.

This program needs nvcc, gcc and Python.  Run the program in a folder that ``prepare.py`` wrote, also on a machine
without impact-posture.  The table of calls needs NumPy, pydantic, CuPy, PyTorch and JAX; a row without its packages
contains the error.  ``--build sm_90`` only builds the programs of the GPU, on a machine without a GPU.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
CUPY_CACHE = HERE / "kernels"
Case = dict[str, Any]


def run(line: list[str], seconds: int = 120) -> str:
    """Run a program in this folder; return its last line, or a JSON object with the error."""
    environment = os.environ | {
        "XLA_PYTHON_CLIENT_PREALLOCATE": "false", "CUPY_CACHE_DIR": str(CUPY_CACHE),
        # The program docs.studies sets this variable to 1.
        "OMP_NUM_THREADS": str(os.cpu_count()),
    }  # fmt: skip
    try:
        done = subprocess.run(
            line, cwd=HERE, env=environment, capture_output=True, text=True, timeout=seconds, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        return json.dumps({"error": str(error)[:200]})
    if done.returncode == 0:
        return (done.stdout.splitlines() or [""])[-1]
    if done.stdout.startswith("{"):
        return done.stdout
    return json.dumps({"error": (done.stderr.strip().splitlines() or ["failed"])[-1][:200]})


def program(case: Case) -> str:
    """Return the name of the program that times a case."""
    return f"{case['name']}-{case['real']}-{case['threads']}"


def build_gpu(case: Case, architecture: str) -> str:
    """Compile the kernel of a case, unless its program is there; return an error or an empty text."""
    if (HERE / program(case)).is_file():
        return ""
    defined = {
        "HEADER": f'"{case["header"]}"', "KERNEL": f"{case['prefix']}_eval_kernel", "REAL": case["real"],
        "THREADS": case["threads"], "ROWS": f"{case['prefix'].upper()}_ROWS",
    }  # fmt: skip
    line = ["nvcc", "-std=c++17", "-O3", f"-arch={architecture}", *[f"-D{k}={v}" for k, v in defined.items()]]
    answer = run([*line, "bench.cu", "-o", program(case)], 300)
    return answer if answer.startswith("{") else ""


def build_cores(case: Case) -> str:
    """Compile the C export of a case for this processor; return an error or an empty text."""
    source = Path(case["header"]).with_suffix(".c")
    defined = [f'-DHEADER="{source.with_suffix(".h")}"', f"-DBATCH={case['prefix']}_eval_batch"]
    line = ["gcc", "-std=gnu99", "-O3", "-march=native", "-fopenmp", "-ffp-contract=fast", *defined]
    answer = run([*line, "cores.c", str(source), "-o", f"cores-{case['name']}", "-lm"], 300)
    return answer if answer.startswith("{") else ""


def row(first: list[str], answer: str, cells: Callable[[Case], list[str]]) -> list[str]:
    """Return a table row: the cells ``first``, then the cells of an answer of :func:`run`, or its error."""
    data = json.loads(answer)
    return [*first, *([data["error"]] if "error" in data else cells(data))]


def times(cases: list[Case]) -> Iterator[list[str]]:
    """Yield a row for each case."""
    for case in cases:
        first = [case["name"], case["real"], f"{case['threads']}"]
        yield row(first, run([f"./{program(case)}", case["samples"], str(case["rows"])]), lambda data: [
            f"{data['threads']}", f"{data['million']:,.0f}", f"{data['best']:,.0f}", f"{data['error_H']:.0e}",
            f"{data['error_grad']:.0e}", f"{data['registers']}", f"{data['local']}", f"{data['call_us']:.1f}",
            f"{data['launch_us']:.1f}",
        ])  # fmt: skip


def table(head: str, rows: Iterator[list[str]]) -> None:
    """Print a Markdown table, row by row."""
    names = head.split("|")
    print("", f"| {' | '.join(names)} |", "|" + "---|" * len(names), sep="\n", flush=True)
    for row in rows:
        print(f"| {' | '.join(row)} |", flush=True)


def cores(cases: list[Case]) -> Iterator[list[str]]:
    """Yield the evaluations per second of the C export on all cores of this machine."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        errors = [*pool.map(build_cores, cases)]
    for case, error in zip(cases, errors, strict=True):
        answer = error or run([f"./cores-{case['name']}", case["samples"]])
        yield row([case["name"]], answer, lambda data: [
            f"{data['cores']}", f"{data['million']:.1f}", f"{data['error_H']:.0e}",
        ])  # fmt: skip


def frameworks(cases: list[Case]) -> Iterator[list[str]]:
    """Yield the times of calls from CuPy, PyTorch and JAX."""
    # Measure the first call with an empty cache of kernels.  Other calls of a case use the same kernel.
    shutil.rmtree(CUPY_CACHE, ignore_errors=True)
    for case in cases:
        for name in ("ip.gpu", "ip.torch", "ip.jax", "ip.jax on CPU"):
            answer = run([sys.executable, "framework_peer.py", name, json.dumps(case)])
            yield row([case["name"], case["real"], name], answer, lambda data: [
                f"{data['first_s']:.1f}", *[f"{us:,.0f}" for us in data["us"]], f"{data['error_H']:.0e}",
                f"{data['error_grad']:.0e}",
            ])  # fmt: skip


def frax(cases: list[Case]) -> Iterator[list[str]]:
    """Yield the evaluations per second of frax."""
    for case in cases:
        for real in ("double", "float"):
            answer = run([sys.executable, "frax_peer.py", case["urdf"], case["root"], real, str(case["rows"] // 8)])
            yield row([case["name"], real], answer, lambda data: [
                f"{data['million']:.2f}", f"{data['compile_s']:.1f}", data["device"],
            ])  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--build", default="", metavar="ARCHITECTURE")
    parser.add_argument("--only", default="", metavar="TEXT")
    args = parser.parse_args()
    began = time.monotonic()
    cases = [c for c in json.loads((HERE / "cases.json").read_text(encoding="utf-8")) if args.only in c["name"]]
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for case, error in zip(cases, pool.map(lambda c: build_gpu(c, args.build or "native"), cases), strict=True):
            if error:
                print(f"{program(case)}: {error}")
    if args.build:
        return 0
    name = run(["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"])
    if name.startswith("{"):
        print(name)
        return 1
    print(f"{name}; {run(['nvcc', '--version'])}; {os.cpu_count()} cores; built in {time.monotonic() - began:.0f} s")
    head = "robot|type|threads|resident|million/s|best|error H|error ∇H|registers|local B|call µs|launch µs"
    table(head, times(cases))
    double = [c for c in cases if c["real"] == "double"]
    table("robot|cores|million/s|error H", cores(double))
    head = "robot|type|call|first call s|1 row µs|4,096 rows|65,536 rows|1,048,576 rows|error H|error ∇H"
    table(head, frameworks([c for c in cases if c["frameworks"]]))
    table("frax|type|million/s|compile s|device", frax([c for c in double if c["frax"]]))
    print(f"\n{time.monotonic() - began:.0f} s")
    return 0


if __name__ == "__main__":
    sys.exit(main())
