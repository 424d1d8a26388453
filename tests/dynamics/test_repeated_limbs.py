"""Repeated limbs in SIMD lanes, compared with Pinocchio on random and known robots."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st

from impact_posture.codegen.block_layout import lay_out
from impact_posture.codegen.compile_and_check import largest_difference
from impact_posture.codegen.export import export
from impact_posture.codegen.export_library import ExportLibrary, NamedObjective, export_library
from impact_posture.codegen.expression_graph import ARITHMETIC, COSINE, Graph
from impact_posture.codegen.self_test import oracle_reference
from impact_posture.codegen.sum_order import reorder_sums
from impact_posture.config.problem_settings import LoadOptions
from impact_posture.dynamics.repeated_limbs import RepeatedLimbs
from impact_posture.impact.impact_case import ImpactCase
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.quantities.impact_oracle import ImpactOracle
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import Support
from impact_posture.system.toolchain import run_compiler
from tests.support.exported import built
from tests.support.helpers import assert_close, random_configurations, rng, robot, unit
from tests.support.tools import need_compiler

KINDS = ("revolute", "prismatic", "continuous")
AXES = ("1 0 0", "0 1 0", "0 0 -1", "0.6 0 0.8")
COMPUTE: dict[str, Callable[..., np.ndarray]] = {
    "+": np.add, "-": np.subtract, "*": np.multiply, "neg": np.negative, "inv": np.reciprocal,
}  # fmt: skip


def limbs_urdf(limb: list[int], limbs: int, seed: int, *, odd: bool) -> str:
    """Return the URDF of a body with equal limbs and random numbers; ``odd`` adds a limb with other joints."""
    generator = np.random.default_rng(seed)

    def numbers(low: float, high: float, count: int = 3) -> str:
        return " ".join(f"{v:.6f}" for v in generator.uniform(low, high, count))

    def link(name: str) -> str:
        a, b, c = generator.uniform(0.01, 0.05, 3)
        # Moments of inertia that are sums of two of three positive numbers satisfy the triangle inequality.
        return (
            f'<link name="{name}"><inertial><origin xyz="{numbers(-0.1, 0.1)}" rpy="{numbers(-1, 1)}"/>'
            f'<mass value="{generator.uniform(0.5, 3):.6f}"/><inertia ixx="{a + b:.6f}" ixy="0" ixz="0"'
            f' iyy="{a + c:.6f}" iyz="0" izz="{b + c:.6f}"/></inertial></link>'
        )

    parts = [link("body")]
    lists = [(f"b{k}", limb) for k in range(limbs)] + ([("odd", [*limb, 5])] if odd else [])
    for name, codes in lists:
        parent = "body"
        for depth, code in enumerate(codes):
            kind, axis = KINDS[code % 3], AXES[code % 4]
            limit = "" if kind == "continuous" else '<limit lower="-2" upper="2" effort="9" velocity="3"/>'
            parts += [
                link(f"{name}_{depth}"),
                f'<joint name="{name}_j{depth}" type="{kind}"><parent link="{parent}"/><child link="{name}_{depth}"/>'
                f'<origin xyz="{numbers(-0.3, 0.3)}" rpy="{numbers(-1, 1)}"/><axis xyz="{axis}"/>{limit}</joint>',
            ]
            parent = f"{name}_{depth}"
    return f'<robot name="limbs">{"".join(parts)}</robot>'


def values_of(graph: Graph, inputs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Evaluate a graph in Python and return its outputs; vectors become arrays."""
    result: list[np.ndarray | float] = []
    for node in graph.nodes:
        x = [result[a] for a in node.operands]
        if node.op == "const":
            value: np.ndarray | float = np.array(node.value) if node.width > 1 else node.value[0]
        elif node.op == "in":
            value = float(inputs[graph.inputs[node.args[0]]][node.args[1]])
        elif node.op == "lane":
            value = np.asarray(x[0])[node.args[1]]
        elif node.op == "gather":
            value = np.array(x)
        elif node.op in ARITHMETIC:
            value = COMPUTE[node.op](*[np.asarray(v) for v in x])
        else:
            value = np.cos(x[0]) if node.op == COSINE else np.sin(x[0])
        assert np.size(value) == node.width
        result.append(value)
    return {name: np.array([float(result[k]) for k in nodes]) for name, nodes in graph.outputs.items()}


def shares(graph: Graph) -> dict[int, int]:
    """Return the number of operations that an output needs, for each vector width."""
    needed: set[int] = set()
    waiting = [k for nodes in graph.outputs.values() for k in nodes]
    while waiting:
        k = waiting.pop()
        if k not in needed:
            needed.add(k)
            waiting += graph.nodes[k].operands
    counts: dict[int, int] = {}
    for k in needed:
        if graph.nodes[k].op in ARITHMETIC:
            counts[graph.nodes[k].width] = counts.get(graph.nodes[k].width, 0) + 1
    return counts


@given(
    st.lists(st.integers(0, 11), min_size=1, max_size=3),
    st.integers(2, 5),
    st.integers(0, 10_000),
    st.booleans(),
    st.sampled_from(["fixed", "free-flyer"]),
    st.sampled_from(["euclidean", "kinetic", "weighted"]),
)
def test_random_limbs_against_pinocchio(
    tmp_path_factory: pytest.TempPathFactory,
    limb: list[int],
    count: int,
    seed: int,
    odd: bool,
    root: str,
    metric: str,
) -> None:
    path = tmp_path_factory.mktemp("limbs") / "limbs.urdf"
    path.write_text(limbs_urdf(limb, count, seed, odd=odd))
    loaded = load_robot(str(path), LoadOptions(root=root))  # type: ignore[arg-type]
    limbs = RepeatedLimbs(loaded.model)
    assert sorted(len(g) for g in limbs.groups) == {2: [2], 3: [2], 4: [4], 5: [4]}[count]
    generator = rng("limbs", seed)
    weights = tuple(generator.uniform(0.5, 2.0, loaded.nv)) if metric == "weighted" else None
    supports = (Support(f"b1_{len(limb) - 1}"),) if seed % 3 == 0 else ()
    contact = ImpactContact(f"b0_{len(limb) - 1}", (0.3, -0.4, 0.9), (0.05, 0.1, -0.02))
    objective = WorstCaseObjective(loaded, contact, Metric(metric, weights), "speed", supports)  # type: ignore[arg-type]
    library = export_library([NamedObjective(objective, "limbs")])
    graph = library.vector_graph()
    assert max(shares(graph)) == (4 if count > 3 else 2)
    for q in random_configurations(loaded.model, 2, "limbs", seed):
        n = unit(generator)
        turned = replace(contact, normal=tuple(n))
        oracle = ImpactOracle(ImpactCase(loaded, turned, objective.metric, supports, objective.compliance))
        expected = oracle.quantities(q)
        values = values_of(graph, {"q": q, "n": n})
        tolerance = 1e-6 if supports else 1e-9
        assert_close(values["o0_H"], [expected.H], tolerance, "H")
        assert_close(values["o0_grad"], oracle.gradient_H(q), tolerance, "gradient of H", 1e-3 * expected.H)
        assert_close(values["o0_a"], expected.jump, tolerance, "jump")
        assert_close(values["o0_L"], expected.ellipsoid.ravel(), tolerance, "ellipsoid")
        n0 = np.array(contact.normal)
        own = ImpactOracle(ImpactCase(loaded, contact, objective.metric, supports, objective.compliance))
        at = values_of(graph, {"q": q, "n": n0})
        assert_close(at["o0_value"], [own.quantities(q).V], tolerance, "objective")


def longest(graph: Graph) -> int:
    """Return the length of the longest chain of dependent operations."""
    depth: list[int] = []
    for node in graph.nodes:
        depth.append((node.op in ARITHMETIC) + max((depth[a] for a in node.operands), default=0))
    return max(depth[k] for nodes in graph.outputs.values() for k in nodes)


@pytest.mark.long(but=("romeo-r_ankle-2-0.75", "panda-panda_hand_tcp-1-1.01", "solo8-base_link-4-0.45"))
@pytest.mark.parametrize(
    ("name", "frame", "width", "most"),
    [
        ("talos", "gripper_right_base_link", 2, 0.65),
        ("solo8", "base_link", 4, 0.45),
        ("romeo", "r_ankle", 2, 0.75),
        ("panda", "panda_hand_tcp", 1, 1.01),
    ],
)
def test_vectors_and_the_order_of_sums_keep_the_values(name: str, frame: str, width: int, most: float) -> None:
    objective = WorstCaseObjective(robot(name), ImpactContact(frame, (0.0, 0.6, 0.8)))
    library = export_library([NamedObjective(objective, name)])
    plain, vectors = library.graph(), library.vector_graph()
    reordered = reorder_sums(vectors)
    counts = shares(vectors)
    assert set(counts) == {1, width}
    assert sum(counts.values()) < most * shares(plain)[1]
    assert longest(reordered) < 0.95 * longest(vectors)
    assert sum(shares(reordered).values()) <= 1.01 * sum(counts.values())
    for q in random_configurations(robot(name).model, 2, name):
        inputs = {"q": q, "n": unit(rng(name))}
        expected = values_of(plain, inputs)
        for graph in (vectors, reordered):
            for output, value in values_of(graph, inputs).items():
                assert_close(value, expected[output], 1e-12, output, 1e-12)
    if name == "talos":
        blocks_are_shared(library)


def blocks_are_shared(library: ExportLibrary) -> None:
    """Check that ``eval`` calls all blocks of ``value``, and that each node is computed only once."""
    layout = lay_out(library.vector_graph(), [f.outputs for f in library.functions])
    calls = {
        function.name: {b for b, block in enumerate(layout.blocks) if k in block.functions}
        for k, function in enumerate(library.functions)
    }
    assert calls["value"] < calls["eval"] and calls["value"] <= calls["jump"]
    assert calls["value"] & calls["ellipsoid"]
    nodes = [k for block in layout.blocks for k in block.nodes]
    assert len(nodes) == len(set(nodes))


def test_limbs_are_outermost_and_disjoint() -> None:
    for name in ("panda", "tilthex_arm", "anymal_c"):
        assert RepeatedLimbs(robot(name).model).groups == ()
    for name in ("talos", "solo12", "hyq", "g1"):
        model = robot(name).model
        limbs = RepeatedLimbs(model)
        joints = [j for group in limbs.groups for limb in group for j in limb]
        assert len(joints) == len(set(joints)) > 0
        for group in limbs.groups:
            roots = {int(model.parents[limb[0]]) for limb in group}
            assert len(roots) == 1
            for i, j in zip(group[0], group[1], strict=True):
                assert model.joints[i].shortname() == model.joints[j].shortname()


# Five equal limbs are compiled to one vector of four lanes and one single limb.
@pytest.mark.long(but=("2",))
@pytest.mark.parametrize("count", [2, 5])
def test_compiled_limbs(tmp_path: Path, count: int) -> None:
    need_compiler()
    (tmp_path / "t.urdf").write_text(limbs_urdf([0, 4, 2], count, 7, odd=count == 2))
    loaded = load_robot(str(tmp_path / "t.urdf"), LoadOptions(root="free-flyer"))
    objective = WorstCaseObjective(loaded, ImpactContact("b1_2", (0.3, -0.4, 0.9)), kind="sticking")
    export(objective, tmp_path, prefix="t", check=False)
    strict = ("-Wall", "-Wextra", "-pedantic", "-Werror")
    # Only five limbs are compiled with native instructions; test_angles_near_and_far does so for two limbs.
    with built(tmp_path, "t", strict if count == 2 else (*strict, "-O3", "-march=native")) as compiled:
        assert largest_difference(compiled.gradient, objective, oracle_reference, 5) <= 1e-10


def test_portable_has_no_vectors_and_the_same_numbers(tmp_path: Path) -> None:
    need_compiler()
    objective = WorstCaseObjective(robot("solo8"), ImpactContact("base_link", (0.0, 0.6, 0.8)))
    export(objective, tmp_path, prefix="s", check=False)
    assert "vector_size" in (tmp_path / "s.c").read_text()
    export(objective, tmp_path, prefix="s", portable=True, check=False, force=True)
    text = (tmp_path / "s.c").read_text()
    assert "vector_size" not in text and "__attribute__((unused))" not in text and "V4" not in text.split("#undef")[0]
    with built(tmp_path, "s") as compiled:
        assert largest_difference(compiled.gradient, objective, oracle_reference, 5) <= 1e-10


@pytest.mark.parametrize("flags", [(), ("-O3", "-march=native")], ids=["plain", "native"])
def test_angles_near_and_far(tmp_path: Path, flags: tuple[str, ...]) -> None:
    """H of two links depends only on the difference of their angles, also near pi/2 and for large angles."""
    need_compiler()
    (tmp_path / "t.urdf").write_text(limbs_urdf([0, 0], 2, 3, odd=False))
    loaded = load_robot(str(tmp_path / "t.urdf"), LoadOptions(root="fixed"))
    objective = WorstCaseObjective(loaded, ImpactContact("b0_1", (0.3, -0.4, 0.9)))
    export(objective, tmp_path, prefix="t", check=False)
    n = np.array(objective.contact.normal)
    with built(tmp_path, "t", flags) as compiled:
        for angle in (0.0, 1e-9, math.pi / 4, math.pi / 2, 3.0, -2.5, 100.0, 1e4, 9.99e5, 1.01e6, 1e15, -1e20):
            q = np.full(loaded.nq, angle)
            reduced = np.full(loaded.nq, math.atan2(math.sin(angle), math.cos(angle)))
            expected = ImpactOracle(ImpactCase(loaded, objective.contact, objective.metric)).quantities(reduced)
            code, H, _ = compiled.eval(q, n)
            assert code == 0
            # For a large angle, the rounding of the angle itself limits the accuracy.
            assert pytest.approx(expected.H, rel=1e-11) == H, angle


def test_a_limb_with_another_axis_is_not_repeated() -> None:
    model = pin.Model()
    inertia = pin.Inertia(1.0, np.array([0.1, 0, 0]), np.eye(3) * 0.1)
    for k, joint in enumerate((pin.JointModelRX(), pin.JointModelRY(), pin.JointModelRX())):
        j = model.addJoint(0, joint, pin.SE3(np.eye(3), np.array([0.0, 0.1 * k, 0.0])), f"j{k}")
        model.appendBodyToJoint(j, inertia, pin.SE3.Identity())
    assert RepeatedLimbs(model).groups == (((1,), (3,)),)


def test_two_exports_in_one_unit(tmp_path: Path) -> None:
    """Two C files form one translation unit; macros of the first file must not affect the second file."""
    compiler = need_compiler()
    for name, frame in (("solo8", "base_link"), ("panda", "panda_hand_tcp")):
        (tmp_path / name).mkdir()
        objective = WorstCaseObjective(robot(name), ImpactContact(frame, (0.0, 0.6, 0.8)))
        export(objective, tmp_path / name, prefix=name, check=False)
    (tmp_path / "both.c").write_text('#include "solo8/solo8.c"\n#include "panda/panda.c"\n')
    strict = ("-std=c99", "-Wall", "-Wextra", "-pedantic", "-Werror")
    run_compiler([*compiler, *strict, "-O0", "-c", "both.c", "-o", "both.o"], tmp_path)


def test_the_prefix_costs_no_room(tmp_path: Path) -> None:
    """Variable names in the C code remain short for any prefix, even with thousands of operations."""
    objective = WorstCaseObjective(robot("talos"), ImpactContact("gripper_right_base_link", (0.0, 0.6, 0.8)))
    export(objective, tmp_path, check=False)
    (source,) = tmp_path.glob("talos*.c")
    assert source.stat().st_size <= 350_000
