"""Pinocchio C++ from the wheel's headers: builds ``pinocchio_peer.cpp`` and hands it the model."""

from __future__ import annotations

import ctypes
import os
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.benchmark.case import Case, Vector
from impact_posture.benchmark.peer import Peer
from impact_posture.benchmark.workbench import CONTRACT, HERE, Absent, Workbench, cxx_compiler

# Boost.MPL's preprocessed headers stop below the number of Pinocchio's joint types.
DEFINITIONS = (
    "BOOST_MPL_LIMIT_LIST_SIZE=30",
    "BOOST_MPL_LIMIT_VECTOR_SIZE=30",
    "BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
    "BOOST_FUSION_INVOKE_MAX_ARITY=12",
    "FUSION_MAX_VECTOR_SIZE=12",
    "NDEBUG",
)
FLAGS = ("-std=c++17", "-O3", "-march=native", CONTRACT)

# The first is Pinocchio's own derivative algorithms; the others are by hand in part or whole.
DERIVATIVES = "Pinocchio derivatives"
FORMULATIONS = {
    DERIVATIVES: ("crba, its Cholesky, computeRNEADerivatives", "peer_eval_rnea", "peer_value_chol"),
    "Pinocchio Cholesky": ("crba, its Cholesky, the sweeps by hand", "peer_eval_chol", "peer_value_chol"),
    "Pinocchio ABA": ("aba, the rest by hand", "peer_eval_aba", "peer_value_aba"),
    "Pinocchio by hand": ("all by hand on its spatial types", "peer_eval_hand", "peer_value_hand"),
}
_REASONS = {1: "a joint of several degrees of freedom", 2: "armature on the free-flyer"}


def peers(case: Case, bench: Workbench) -> list[Peer]:
    """Every formulation; they share one library and one loaded model, so use one case at a time.

    Raises:
        Absent: No C++ compiler or headers, or a model that the peer does not do.
    """
    include, eigen = pinocchio_headers(), eigen_headers()
    flags = [*FLAGS, *[f"-D{d}" for d in DEFINITIONS], "-isystem", str(include), "-isystem", str(eigen)]
    sources = {name: (HERE / name).read_text() for name in ("pinocchio_peer.cpp", "pinocchio_peer.hpp")}
    arrays = _model_arrays(case)
    built = bench.build("Pinocchio C++, once for all robots", sources, cxx_compiler(), flags, ())
    _load(built.library, case, arrays)
    return [
        Peer(
            name,
            "pinocchio",
            what,
            built.symbol(of_eval),
            built.symbol(of_value),
            built.flags,
            built.compile_s,
            built.library,
        )
        for name, (what, of_eval, of_value) in FORMULATIONS.items()
    ]


def pinocchio_headers() -> Path:
    """Beside the ``pin`` wheel.

    Raises:
        Absent: They are not there.
    """
    own = find_spec("pinocchio")
    root = Path(str(own.origin)).parents[4] if own and own.origin else Path()
    for folder in (root / "include", *(p / "include" for p in _prefixes())):
        if (folder / "pinocchio" / "algorithm" / "crba.hpp").is_file():
            return folder
    raise Absent("no Pinocchio headers beside the pin wheel")


def eigen_headers() -> Path:
    """``$EIGEN3_INCLUDE_DIR``, the wheel cmeel-eigen, the distribution, or what CasADi's wheel brings.

    Raises:
        Absent: None of them.
    """
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


def _model_arrays(case: Case) -> list[NDArray[Any]]:
    """Parents, joints, axes, placements, inertias, armature, as ``peer_load`` takes them."""
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
    return [parents, kinds, axes, placements, inertias, np.ascontiguousarray(model.armature, dtype=float)]


def _load(library: ctypes.CDLL, case: Case, arrays: list[NDArray[Any]]) -> None:
    """Give the C++ side a copy of the model."""
    joint, position = case.point
    library.peer_load.argtypes = [ctypes.c_int] + [ctypes.c_void_p] * 6 + [ctypes.c_int, ctypes.c_void_p]
    pointers = [a.ctypes.data for a in arrays]
    code = library.peer_load(len(arrays[0]), *pointers, joint, position.ctypes.data)
    if code:
        raise Absent(f"{case.robot.name} has {_REASONS.get(code, 'something new')}")


def _kind(joint: pin.JointModel) -> tuple[int, Vector]:
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
    raise Absent(f"joints of type {name} are not in the C++ peer")
