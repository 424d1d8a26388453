"""Build ``pinocchio_peer.cpp`` with the headers of the Pinocchio wheel, and pass the robot model to it."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path

import numpy as np
import pinocchio as pin

from docs.studies.build import CONTRACT, build
from docs.studies.core import Vector, say
from docs.studies.kernel.harness import Absent, Kernel, Samples
from tests.support.tools import cxx_compiler, eigen_headers

# The preprocessed headers of Boost.MPL support fewer types than Pinocchio has joint types.
DEFINITIONS = (
    "BOOST_MPL_LIMIT_LIST_SIZE=30", "BOOST_MPL_LIMIT_VECTOR_SIZE=30", "BOOST_MPL_CFG_NO_PREPROCESSED_HEADERS",
    "BOOST_FUSION_INVOKE_MAX_ARITY=12", "FUSION_MAX_VECTOR_SIZE=12", "NDEBUG",
)  # fmt: skip
# With the default limits of GCC, the inlining of a formulation depends on the other formulations.  This dependence
# changes the time of a formulation by up to a fifth.
_INLINE = ("inline-unit-growth=400", "large-function-growth=2000", "large-stack-frame-growth=10000")
_PARAMETERS = [*[f"--param={p}" for p in _INLINE], *[f"-D{d}" for d in DEFINITIONS]]
_FLAGS = ("-std=c++17", "-O3", "-march=native", CONTRACT, *_PARAMETERS)
# The first formulation uses derivative algorithms of Pinocchio; the others are partly or fully handwritten.  Each
# name maps to the functions for H with ∇H, and for H.
DERIVATIVES = "Pinocchio derivatives"
FORMULATIONS = {
    DERIVATIVES: ("rnea", "chol"),
    "Pinocchio Cholesky": ("chol", "chol"),
    "Pinocchio ABA": ("aba", "aba"),
    "Pinocchio by hand": ("hand", "hand"),
}
_FREE_FLYER = 8


def kernels(samples: Samples) -> list[Kernel]:
    """Build every formulation.  All formulations share one library and one loaded model, so time one robot at a time.

    Raises:
        Absent: The C++ compiler or headers are missing, or the peer does not support the model.
    """
    arrays = model_arrays(samples.robot.model)
    compiler, eigen = cxx_compiler(), eigen_headers()
    folders = (Path(folder) / "cmeel.prefix" / "include" for folder in sys.path)
    headers = next((f for f in folders if (f / "pinocchio" / "algorithm" / "crba.hpp").is_file()), None)
    if compiler is None or eigen is None or headers is None:
        raise Absent("no C++ compiler (set CXX), no headers beside the pin wheel, or no Eigen (EIGEN3_INCLUDE_DIR)")
    say("Pinocchio C++, once for all robots")
    text = Path(__file__).with_name("pinocchio_peer.cpp").read_text(encoding="utf-8")
    built = build({"pinocchio_peer.cpp": text}, compiler, _FLAGS, (headers, eigen))
    arrays.append(np.array(samples.point.position, dtype=float))
    *pointers, position = (ctypes.c_void_p(a.ctypes.data) for a in arrays)
    built.library.peer_load(len(arrays[0]), *pointers, samples.point.joint, position)
    kinds = {
        name: {"eval": built.symbol(f"peer_eval_{one}"), "value": built.symbol(f"peer_value_{other}")}
        for name, (one, other) in FORMULATIONS.items()
    }
    return [Kernel(name, "pinocchio", built, functions) for name, functions in kinds.items()]


def model_arrays(model: pin.Model) -> list[np.ndarray]:
    """Return parents, joints, axes, placements, inertias and armature for ``peer_load``.

    Raises:
        Absent: The peer does not support a joint of the model, or the free-flyer has armature.
    """
    links = range(1, model.njoints)
    kinds, axes = zip(*[_kind(model.joints[i]) for i in links], strict=True)
    if _FREE_FLYER in kinds[1:] or (kinds[0] == _FREE_FLYER and np.any(model.armature[:6])):
        raise Absent("supports only a free-flyer at the root, without armature")
    placed = [model.jointPlacements[i] for i in links]
    bodies = [model.inertias[i] for i in links]
    return [
        np.array([model.parents[i] for i in links], dtype=np.int32),
        np.array(kinds, dtype=np.int32),
        np.array(axes),
        np.array([[*at.translation, *at.rotation.T.ravel()] for at in placed]),
        np.array([[body.mass, *body.lever, *body.inertia.T.ravel()] for body in bodies]),
        np.ascontiguousarray(model.armature, dtype=float),
    ]


def _kind(joint: pin.JointModel) -> tuple[int, Vector]:
    name = joint.shortname().replace("JointModel", "")
    if name == "FreeFlyer":
        return _FREE_FLYER, np.zeros(3)
    if name in ("RX", "RY", "RZ", "PX", "PY", "PZ"):
        return "XYZ".index(name[1]) + (4 if name[0] == "P" else 0), np.zeros(3)
    if name in ("RevoluteUnaligned", "PrismaticUnaligned"):
        data = joint.createData()
        joint.calc(data, np.zeros(joint.idx_q + 1))
        S = np.asarray(data.S).ravel()
        return (3, S[3:]) if name[0] == "R" else (7, S[:3])
    raise Absent(f"joints of type {name} are not in the C++ peer")
