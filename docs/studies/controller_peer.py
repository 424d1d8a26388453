"""Tick of a controller in C++ with Pinocchio and DAQP, for comparison with the exported controller."""

from __future__ import annotations

import subprocess
import tarfile
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import casadi
import numpy as np
import pinocchio as pin

from docs.studies.core import Vector
from docs.studies.kernel.pinocchio import DEFINITIONS
from impact_posture.controller_export.daqp_sources import VERSION, daqp_sources
from impact_posture.system.libraries import cache_folder
from impact_posture.tsid.controller import Controller, Status
from tests.support.exported_controller import formulation_of

SOURCE = Path(__file__).with_suffix(".cpp")
_REPETITIONS, _MOST = 7, 500
_PREFIX = Path(pin.__file__).parents[4]


class Missing(Exception):
    """This machine lacks a requirement of the C++ controller."""


@contextmanager
def peer() -> Iterator[Path]:
    """Build the C++ controller.  The build takes minutes, because it compiles the algorithms of Pinocchio.

    Raises:
        Missing: Headers or a compiler are missing, or the source distribution of DAQP is not in the cache.
    """
    if not (_PREFIX / "include" / "pinocchio" / "algorithm" / "crba.hpp").is_file():
        raise Missing(f"no headers of Pinocchio in {_PREFIX.name}")
    daqp_sources()
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        with tarfile.open(cache_folder() / f"daqp-{VERSION}.tar.gz") as tar:
            tar.extractall(folder, filter="data")
        daqp = folder / f"daqp-{VERSION}" / "csrc"
        yield _build(folder, daqp)


def _build(folder: Path, daqp: Path) -> Path:
    program = folder / "peer"
    sources = [str(path) for path in (daqp / "src").glob("*.c")]
    library = str(next((_PREFIX / "lib").glob("libboost_serialization.so*"), "-lboost_serialization"))
    headers = ["-I", str(daqp / "include"), "-isystem", str(_PREFIX / "include")]
    # Use the Eigen headers in the wheel of CasADi, because the wheel of Pinocchio contains none.
    eigen = ["-isystem", str(Path(casadi.__file__).parent / "include" / "eigen3")]
    definitions = [f"-D{word}" for word in DEFINITIONS]
    objects = [f"{Path(source).stem}.o" for source in sources]
    commands = [
        ["cc", "-O2", *headers, "-c", *sources],
        ["c++", "-std=c++17", "-O2", *definitions, *headers, *eigen, str(SOURCE), "-o", str(program), *objects,
         library, f"-Wl,-rpath,{_PREFIX / 'lib'}", "-lm"],
    ]  # fmt: skip
    for command in commands:
        try:
            subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True)
        except FileNotFoundError:
            raise Missing(f"no {command[0]}") from None
        except subprocess.CalledProcessError as error:
            raise Missing(f"{command[0]} failed: {error.stderr[:300]}") from None
    return program


def times(program: Path, name: str, recorded: list[Vector]) -> tuple[float, float]:
    """Return the median and the 99th percentile of the tick times, µs, from the shortest time of each tick."""
    robot, formulation = formulation_of(name)
    controller = Controller(robot, formulation)
    controller.reset(robot.posture(), np.zeros(robot.nv))
    tasks = [*(task for level in formulation.levels for task in level), *formulation.weighted]
    frames = {contact.point.frame for contact in formulation.contacts}
    frames |= {frame for task in tasks if isinstance(frame := getattr(task, "frame", None), str)}
    with tempfile.TemporaryDirectory() as scratch:
        model, data = Path(scratch) / "model", Path(scratch) / "ticks"
        robot.model.saveToBinary(str(model))
        qp = controller.assembly.rank.qp
        with data.open("wb") as file:
            ids = [robot.model.getFrameId(frame) for frame in sorted(frames)]
            file.write(np.array([qp.n, qp.m, len(ids), *ids, *qp.sense], dtype=np.intc).tobytes())
            for k, state in enumerate(recorded[:_MOST]):
                command = controller.tick(1e-3 * k, state[: robot.nq], state[robot.nq :])
                qp = controller.assembly.rank.qp
                if command.status is Status.SOLVED and not controller.report().deficient:
                    z = [command.acceleration, command.forces]
                    arrays = [state, qp.H, qp.g, qp.A, qp.upper, qp.lower, *z]
                    file.write(np.concatenate([np.ravel(x) for x in arrays]).tobytes())
        runs = []
        for _ in range(_REPETITIONS):
            ran = subprocess.run([program, model, data], capture_output=True, text=True)
            if ran.returncode:
                raise Missing(f"answers differ: {ran.stdout.splitlines()[-1:]}")
            runs.append([int(line) for line in ran.stdout.split()])
    least = np.min(np.array(runs), axis=0) / 1e3
    return float(np.median(least)), float(np.percentile(least, 99))
