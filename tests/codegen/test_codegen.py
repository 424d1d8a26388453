"""The C export is generated, compiled and loaded, then compared with CasADi, finite differences and Pinocchio."""

from __future__ import annotations

import ctypes
import json
import re
import subprocess
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from jinja2 import UndefinedError

from impact_posture.codegen.compile_and_check import largest_difference
from impact_posture.codegen.export import Export, export
from impact_posture.codegen.export_files import Verbatim, environment
from impact_posture.codegen.self_test import casadi_reference, oracle_reference, sample_postures
from impact_posture.config.problem_settings import ObjectiveKind
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.escape import c_comment
from impact_posture.system.toolchain import run_compiler
from tests.support import exported
from tests.support.exported import Exported
from tests.support.tools import STRICT, need, need_compiler

OPTIMIZED = True

KINOVA = "example-robot-data:kinova_description/robots/kinova.urdf"
UNIT = np.array([0.6, 0.0, 0.8])


@dataclass(frozen=True)
class Case:
    robot: str
    frame: str
    supported: bool = False
    kind: ObjectiveKind = "impulse"
    metric: str = "euclidean"
    in_frame: bool = False

    def build(self) -> WorstCaseObjective:
        robot = load_robot(self.robot)
        supports = robot.spec.supports if self.supported else ()
        metric = (
            Metric("weighted", tuple(np.linspace(0.5, 2.0, robot.nv)), "test")
            if self.metric == "weighted"
            else Metric("kinetic" if self.metric == "kinetic" else "euclidean")
        )
        contact = ImpactContact(
            self.frame, (1.0, 0.3, -0.2), (0.01, 0.02, 0.0), "contact" if self.in_frame else "world", 1.7
        )
        return WorstCaseObjective(robot, contact, metric, self.kind, supports)


CASES = {
    "solo8-standing": Case("solo8", "base_link", supported=True),
    "solo8-free": Case("solo8", "base_link", kind="speed"),
    "tilthex_arm": Case("tilthex_arm", "ee", kind="sticking"),
    "panda": Case("panda", "panda_hand_tcp", metric="weighted"),
    "kinova": Case(KINOVA, "j2s6s200_end_effector", kind="energy"),
    "solo12-standing": Case("solo12", "base_link", supported=True, kind="coulomb"),
    "hextilt": Case("hextilt", "flying_arm_5__gripper", metric="kinetic", in_frame=True),
}


@dataclass(frozen=True)
class Built:
    objective: WorstCaseObjective
    export: Export
    library: Exported
    folder: Path


LONG = ("solo8-standing", "kinova")


@pytest.fixture(scope="module", params=[pytest.param(c, marks=pytest.mark.long if c in LONG else ()) for c in CASES])
def built(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Built]:
    need_compiler()
    objective = CASES[request.param].build()
    folder = tmp_path_factory.mktemp(request.param)
    robot = objective.robot
    written = export(objective, folder, posture=sample_postures(robot, 1, 7)[0], check=False)
    with exported.built(folder, written.prefix, STRICT) as library:
        yield Built(objective, written, library, folder)


# ---- numbers ------------------------------------------------------------------------------------------------------


def test_agrees_with_casadi(built: Built) -> None:
    # The C code multiplies by reciprocals, so it rounds differently.  Stiff feet (1/ε of 1e4 robot masses) amplify
    # these rounding differences.
    tolerance = 1e-10 if built.objective.supports else 1e-12
    assert largest_difference(built.library.gradient, built.objective, casadi_reference, 10) <= tolerance


def test_agrees_with_pinocchio(built: Built) -> None:
    # For feet with the compliance 1e-4 divided by the robot mass, the oracle solves a KKT system.  The condition
    # number of this system costs at least four digits.
    tolerance = 1e-8 if built.objective.supports else 1e-11
    assert largest_difference(built.library.gradient, built.objective, oracle_reference, 10) <= tolerance


def test_gradients_equal_differences_of_the_values(built: Built) -> None:
    robot, h = built.objective.robot, 1e-5
    q = sample_postures(robot, 1, 11)[0]
    _, H, gradient = built.library.eval(q, UNIT)
    _, value, own = built.library.objective(q)
    differences = np.zeros((2, robot.nv))
    for i in range(robot.nv):
        step = np.zeros(robot.nv)
        step[i] = h
        ahead, behind = pin.integrate(robot.model, q, step), pin.integrate(robot.model, q, -step)
        differences[0, i] = (built.library.value(ahead, UNIT)[1] - built.library.value(behind, UNIT)[1]) / (2 * h)
        differences[1, i] = (built.library.objective(ahead)[1] - built.library.objective(behind)[1]) / (2 * h)
    for result, expected, scale in ((gradient, differences[0], H), (own, differences[1], value)):
        np.testing.assert_allclose(result, expected, atol=1e-6 * max(np.abs(expected).max(), scale), rtol=0)


def test_free_beside_standing(built: Built) -> None:
    """The export of a standing robot also has functions without supports, equal to Pinocchio without supports."""
    objective, frame = built.objective, built.export.manifest["frames"][0]
    assert (frame["free"] is None) == (not objective.supports)
    if objective.supports:
        free = replace(objective, supports=())
        assert largest_difference(built.library.free().gradient, free, oracle_reference, 5) <= 1e-10
        q, n = np.array(frame["self_test"]["q"]), np.array(frame["self_test"]["n"])
        assert frame["free"]["self_test"]["q"] == frame["self_test"]["q"]
        assert abs(built.library.eval(q, n)[1] / frame["free"]["self_test"]["H"] - 1) > 1e-3


def test_objective_carries_the_impulse_bound(built: Built) -> None:
    if built.objective.kind != "impulse":
        assert built.objective.scale == 1.0
        return
    q = sample_postures(built.objective.robot, 1, 5)[0]
    _, H, _ = built.library.eval(q, np.array(built.objective.contact.normal))
    assert built.library.objective(q)[1] == pytest.approx(1.7**2 * H, rel=1e-14)


# ---- codes --------------------------------------------------------------------------------------------------------


def test_codes(built: Built) -> None:
    library, robot = built.library, built.objective.robot
    q = sample_postures(robot, 1, 3)[0]
    assert library.eval(q, UNIT)[0] == library.objective(q)[0] == library.value(q, UNIT)[0] == 0
    for bad in (np.nan, np.inf):
        broken = q.copy()
        broken[-1] = bad
        code, H, gradient = library.eval(broken, UNIT)
        assert code == library.objective(broken)[0] == library.value(broken, UNIT)[0] == 1
        assert np.isnan(H) and np.isnan(gradient).all()  # the function has not written its outputs
        assert library.eval(q, np.array([bad, 0, 0]))[0] == library.value(q, np.array([0, bad, 0]))[0] == 1


def test_a_norm_other_than_one_is_refused(built: Built) -> None:
    library, robot = built.library, built.objective.robot
    q = sample_postures(robot, 1, 3)[0]
    units = [slice(3, 7)] if robot.floating else []
    for i in range(1, robot.model.njoints):
        if robot.model.nqs[i] == 2:
            units.append(slice(robot.model.idx_qs[i], robot.model.idx_qs[i] + 2))
    assert bool(units) == (robot.name != "panda")
    for unit in units:
        near, far = q.copy(), q.copy()
        near[unit] *= 1 + 5e-7
        far[unit] *= 1 - 2e-6
        assert library.eval(near, UNIT)[0] == 0
        code, H, gradient = library.eval(far, UNIT)
        assert code == library.objective(far)[0] == library.value(far, UNIT)[0] == 2
        assert np.isnan(H) and np.isnan(gradient).all()


# ---- the source ---------------------------------------------------------------------------------------------------


def test_no_allocation_and_no_state(built: Built) -> None:
    source = (built.folder / f"{built.export.prefix}.c").read_text()
    assert "alloc" not in source
    static = [line for line in source.splitlines() if re.search(r"\bstatic\b", line)]
    assert len(static) >= 4
    assert all(re.match(r"\s*(#define APART static|static (const |(int|void) \w+\())", line) for line in static)


def test_library_holds_no_writable_data(built: Built) -> None:
    lines = subprocess.run(
        [need("nm"), built.library.gradient._library._name], capture_output=True, text=True, check=True
    ).stdout.splitlines()
    symbols = [line.split()[-2:] for line in lines]
    # Ignore compiler symbols: their names begin with an underscore or with ``completed``.
    own = [(kind, name) for kind, name in symbols if not name.startswith(("_", "completed."))]
    assert not [name for kind, name in own if kind in "bBdDcCsSgG"]
    names = {name for kind, name in own if kind in "TR"}
    free = built.export.manifest["frames"][0]["free"]
    expected = set(built.export.manifest["symbols"].values()) | set(free["symbols"].values() if free else ())
    assert names == expected


def test_gradient_may_overwrite_the_configuration(built: Built) -> None:
    q = sample_postures(built.objective.robot, 1, 4)[0]
    _, H, gradient = built.library.eval(q, UNIT)
    shared, value, n = q.copy(), np.zeros(1), UNIT.copy()
    pointers = [v.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) for v in (shared, n, value, shared)]
    assert getattr(built.library.gradient._library, f"{built.export.prefix}_eval")(*pointers) == 0
    assert value[0] == H
    np.testing.assert_array_equal(shared[: gradient.size], gradient)


def test_posture_is_a_constant(built: Built) -> None:
    robot, prefix = built.objective.robot, built.export.prefix
    array = (ctypes.c_double * robot.nq).in_dll(built.library.gradient._library, f"{prefix}_posture")
    np.testing.assert_array_equal(np.array(array), sample_postures(robot, 1, 7)[0])
    np.testing.assert_array_equal(built.export.manifest["posture"], np.array(array))


# Two of the robots have code with SIMD vectors and comparisons; one robot has neither.
@pytest.mark.long(but=("hextilt",))
@pytest.mark.parametrize("built", ["solo12-standing", "hextilt"], indirect=True)
def test_compiles_as_cpp(built: Built, tmp_path: Path) -> None:
    compiler = need("g++")
    prefix = built.export.prefix
    use = tmp_path / "use.cpp"
    use.write_text(
        f'#include "{prefix}.h"\n'
        f"int main() {{ double H, g[{prefix.upper()}_NV]; const double n[3] = {{0, 0, 1}};\n"
        f"  return {prefix}_eval({prefix}_posture, n, &H, g) || !(H > 0); }}\n"
    )
    command = [compiler, "-x", "c++", "-std=c++17", *STRICT, "-I", ".", f"{prefix}.c", str(use)]
    run_compiler([*command, "-o", str(tmp_path / "use"), "-lm"], built.folder)
    assert subprocess.run([tmp_path / "use"], check=False).returncode == 0


def test_manifest(built: Built) -> None:
    manifest = json.loads((built.folder / f"{built.export.prefix}.json").read_text())
    assert manifest == built.export.manifest
    robot, contact = built.objective.robot, built.objective.contact
    assert manifest["schema"] == "impact-posture/codegen/1"
    assert manifest["model_sha256"] == robot.model_sha256
    assert manifest["joint_names"] == list(robot.joint_names)
    assert len(manifest["q_names"]) == manifest["nq"] == robot.nq
    assert len(manifest["v_names"]) == manifest["nv"] == robot.nv
    assert manifest["normal"] == list(contact.normal)
    assert [s["frame"] for s in manifest["supports"]] == [s.frame for s in built.objective.supports]
    assert (manifest["support_compliance"] is None) == (not built.objective.supports)
    test = manifest["self_test"]
    code, H, gradient = built.library.eval(np.array(test["q"]), np.array(test["n"]))
    assert code == 0
    tolerance = 1e-10 if built.objective.supports else 1e-12
    assert pytest.approx(test["H"], rel=tolerance) == H
    np.testing.assert_allclose(gradient, test["grad"], atol=tolerance * np.abs(test["grad"]).max())


def test_texts_name_what_they_are_of(built: Built) -> None:
    prefix, robot = built.export.prefix, built.objective.robot
    header, readme = (built.folder / f"{prefix}.h").read_text(), (built.folder / "README.md").read_text()
    for text in (header, readme):
        assert built.objective.contact.frame in text
        assert all(name in text for name in robot.joint_names)
        assert ("contact frame" in text) == (built.objective.contact.normal_frame == "contact")
    assert f"#define {prefix.upper()}_NQ {robot.nq}\n" in header
    assert f"#define {prefix.upper()}_NV {robot.nv}\n" in header
    assert all(line == line.rstrip() and line.isascii() for line in header.splitlines())


# ---- names, folders, inputs ---------------------------------------------------------------------------------------


def test_templates_escape_every_text_and_refuse_unknown_names() -> None:
    templates = environment("impact_posture.codegen", c_comment)
    assert templates.from_string("{{ name }} {{ code }}").render(name="*/", code=Verbatim("*/")) == "_/ */"
    assert templates.from_string("{{ values | doubles }}").render(values=[-1.5]) == "{\n    -1.5\n  }"
    for text in (
        "{{ nobody }}",
        "{{ name.nobody }}",
        "{% if nobody %}{% endif %}",
        "{% for x in nobody %}{% endfor %}",
    ):
        with pytest.raises(UndefinedError):
            templates.from_string(text).render(name="x")
