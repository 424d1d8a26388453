"""Pinocchio C++ from the wheel's headers: builds ``pinocchio_peer.cpp`` and hands it the model."""

from __future__ import annotations

import ctypes
import os
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pinocchio as pin

from tests.benchmarks.kernel.build import HERE, Absent, build, find, symbol
from tests.benchmarks.kernel.case import Case
from tests.benchmarks.kernel.peer import Peer

# Boost.MPL's preprocessed headers stop below the number of Pinocchio's joint types.
DEFINITIONS = (
    "BOOST_MPL_LIMIT_LIST_SIZE=30",
    "BOOST_MPL_LIMIT_VECTOR_SIZE=30",
    "BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
    "BOOST_FUSION_INVOKE_MAX_ARITY=12",
    "FUSION_MAX_VECTOR_SIZE=12",
    "NDEBUG",
)
FLAGS = ("-std=c++17", "-O3", "-march=native")
# Templates over every joint type: a minute on a quiet machine.
LIMIT_S = 900.0

FORMULATIONS = {
    "Pinocchio rnea": ("crba + cholesky + computeRNEADerivatives", "peer_eval_rnea", "peer_value_chol"),
    "Pinocchio chol": ("crba + cholesky, sweeps by hand", "peer_eval_chol", "peer_value_chol"),
    "Pinocchio aba": ("aba(), the rest by hand", "peer_eval_aba", "peer_value_aba"),
    "Pinocchio hand": ("all by hand on its spatial types", "peer_eval_hand", "peer_value_hand"),
}
_REASONS = {1: "a joint of several degrees of freedom", 2: "armature on the free-flyer"}


def peers(case: Case, notes: list[str]) -> list[Peer]:
    """Every formulation; they share one library and one loaded model, so use one case at a time.

    Raises:
        Absent: No C++ compiler or headers, or a model that the peer does not do.
    """
    include, eigen = pinocchio_headers(), eigen_headers()
    flags = [*FLAGS, *[f"-D{d}" for d in DEFINITIONS], "-isystem", str(include), "-isystem", str(eigen)]
    compiler = find(os.environ.get("CXX", ""), "g++", "clang++", "c++")
    sources = {name: (HERE / name).read_text() for name in ("pinocchio_peer.cpp", "pinocchio_peer.hpp")}
    built = build(sources, compiler, flags, [], LIMIT_S)
    load(built.library, case)
    return [
        Peer(
            f"{name} ({what})",
            symbol(built.library, of_eval),
            symbol(built.library, of_value),
            built.command,
            built.compile_s,
            built.library,
        )
        for name, (what, of_eval, of_value) in FORMULATIONS.items()
    ]


def pinocchio_headers() -> Path:
    own = find_spec("pinocchio")
    root = Path(str(own.origin)).parents[4] if own and own.origin else Path()
    for folder in (root / "include", *(p / "include" for p in _prefixes())):
        if (folder / "pinocchio" / "algorithm" / "crba.hpp").is_file():
            return folder
    raise Absent("no Pinocchio headers beside the pin wheel")


def eigen_headers() -> Path:
    """``$EIGEN3_INCLUDE_DIR``, the wheel cmeel-eigen, the distribution, or what CasADi's wheel brings."""
    casadi = find_spec("casadi")
    candidates = [
        Path(os.environ.get("EIGEN3_INCLUDE_DIR") or "/nonexistent"),
        *(p / "include" / "eigen3" for p in _prefixes()),
        Path("/usr/include/eigen3"),
        Path("/usr/local/include/eigen3"),
        Path(str(casadi.origin)).parent / "include" / "eigen3" if casadi else Path("/nonexistent"),
    ]
    for folder in candidates:
        if (folder / "Eigen" / "Cholesky").is_file():
            return folder
    raise Absent("no Eigen headers (pip install cmeel-eigen, or set EIGEN3_INCLUDE_DIR)")


def _prefixes() -> list[Path]:
    return [Path(folder) / "cmeel.prefix" for folder in sys.path if (Path(folder) / "cmeel.prefix").is_dir()]


def load(library: ctypes.CDLL, case: Case) -> None:
    """Give the C++ side a copy of the model: parents, joints, placements, inertias, armature."""
    model = case.robot.model
    count = model.njoints - 1
    parents = np.array([model.parents[i] for i in range(1, count + 1)], dtype=np.int32)
    kinds, axes = np.zeros(count, dtype=np.int32), np.zeros((count, 3))
    placements, inertias = np.zeros((count, 12)), np.zeros((count, 13))
    for k in range(count):
        joint, body, at = model.joints[k + 1], model.inertias[k + 1], model.jointPlacements[k + 1]
        kinds[k], axes[k] = _kind(joint)
        placements[k] = [*at.translation, *at.rotation.T.ravel()]
        inertias[k] = [body.mass, *body.lever, *body.inertia.T.ravel()]
    armature = np.ascontiguousarray(model.armature, dtype=float)
    joint, position = case.point
    library.peer_load.argtypes = [ctypes.c_int] + [ctypes.c_void_p] * 6 + [ctypes.c_int, ctypes.c_void_p]
    arrays = [parents, kinds, axes, placements, inertias, armature]
    code = library.peer_load(count, *[a.ctypes.data for a in arrays], joint, position.ctypes.data)
    if code:
        raise Absent(f"{case.robot.name} has {_REASONS.get(code, 'something new')}")


def _kind(joint: pin.JointModel) -> tuple[int, np.ndarray]:
    name = joint.shortname().replace("JointModel", "")
    if name == "FreeFlyer":
        return 8, np.zeros(3)
    if name in ("RX", "RY", "RZ", "PX", "PY", "PZ"):
        return "XYZ".index(name[1]) + (4 if name[0] == "P" else 0), np.zeros(3)
    if name in ("RevoluteUnaligned", "PrismaticUnaligned"):
        data = joint.createData()
        joint.calc(data, np.zeros(1))
        S = np.asarray(data.S).ravel()
        return (3, S[3:]) if name[0] == "R" else (7, S[:3])
    raise Absent(f"joint type {name}")
