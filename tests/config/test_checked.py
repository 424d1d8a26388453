"""Every public function and class rejects invalid arguments with a one-line error that names the parameter."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

import impact_posture as ip
from impact_posture import tsid
from impact_posture.config.checked import checked
from impact_posture.errors import InputError
from impact_posture.posture.search.multistart import PostureSolution

ROBOT = ip.load_robot("tilthex_arm")
CONTACT = ip.ImpactContact("ee", (0, 0, 1))
OBJECTIVE = ip.ImpactObjective(ROBOT, CONTACT)
PROBLEM = ip.PostureProblem(OBJECTIVE, base="level")
RESULT = ip.PostureResult(PROBLEM, object.__new__(PostureSolution))
POSTURE = tsid.JointPosture(ROBOT)
POINT = tsid.Point("ee")
FORMULATION = tsid.aerial_formulation(ROBOT, POSTURE)

GOOD: list[tuple[Callable[..., Any], dict[str, Any]]] = [
    (ip.load_robot, {"robot": "ur5"}),
    (ip.ImpactContact, {"frame": "ee", "normal": (0, 0, 1)}),
    (ip.Metric, {}),
    (ip.Support, {"frame": "ee"}),
    (ip.ImpactObjective, {"robot": ROBOT, "contact": CONTACT}),
    *[(call, {"q": ROBOT.posture()}) for call in (OBJECTIVE.evaluate, OBJECTIVE.value_and_gradient)],
    (OBJECTIVE.export, {"out": "out"}),
    (ip.PostureProblem, {"objective": OBJECTIVE}),
    (ip.optimize, {"problem": PROBLEM}),
    (RESULT.trade_off, {}),
    (RESULT.path, {}),
    (RESULT.save, {"out": "out"}),
    (RESULT.plot, {"out": "out"}),
    (RESULT.export, {"out": "out"}),
    *[(getattr(ROBOT, name), {"name": "ee"}) for name in ("frame_id", "joint_id", "posture")],
    (ROBOT.contact_pose, {"frame": "ee"}),
    *[(getattr(ROBOT, name), {"q": ROBOT.posture()}) for name in ("check_posture", "check_limits")],
    *[(load, {"path": "out"}) for load in (ip.ImpactGradient.load, ip.gpu.load, ip.jax.load, ip.torch.load)],
    (ip.CompiledController.load, {"path": "out"}),
    (ip.export_controller, {"robot": ROBOT, "formulation": FORMULATION}),
    (ip.sweep.open, {"folder": "out"}),
    *[(task, {}) for task in (tsid.BaseOrientation, tsid.CenterOfMass, tsid.Tilt)],
    *[(task, {"point": POINT}) for task in (tsid.FrameAligned, tsid.FramePose, tsid.FramePosition)],
    (tsid.JointPosture, {"robot": ROBOT}),
    (POSTURE.move_to, {"target": ROBOT.posture()}),
    *[
        (task, {"robot": ROBOT, "gradient": lambda q, n: (0.0, q)})
        for task in (tsid.ImpactRobustPosture, tsid.ReferenceFlowPosture)
    ],
    (tsid.Controller, {"robot": ROBOT, "formulation": FORMULATION}),
    (tsid.FlowOptions, {}),
    (tsid.Impedance, {"mass": 1.0}),
    (tsid.LimitLaw, {}),
    (tsid.Point, {"frame": "ee"}),
    (tsid.SupportContact, {"point": POINT}),
    (tsid.TaskFormulation, {}),
    *[
        (made, {"robot": ROBOT, "posture": POSTURE})
        for made in (tsid.aerial_formulation, tsid.arm_formulation, tsid.legged_formulation)
    ],
    (tsid.support_contacts, {"robot": ROBOT}),
]
# Posture tasks create ReferenceFlow objects, and Task is a base class.  The remaining names are result types.
OTHERS = {
    "Export", "ImpactPostureError", "PostureResult", "Robot", "__version__", "known_robots", "sweep", "tsid",
    "ImpactGradient", "CompiledController", "gpu", "jax", "torch",
    "Command", "Phase", "ReferenceFlow", "Report", "Status", "Task",
}  # fmt: skip


class Odd:
    """Value that is invalid for every parameter."""


def _parameters() -> list[Any]:
    return [
        pytest.param(function, good, name, id=f"{function.__qualname__}-{name}")
        for function, good in GOOD
        for name, parameter in inspect.signature(function).parameters.items()
        if parameter.kind is not parameter.VAR_KEYWORD
    ]


def test_every_public_name_is_tried() -> None:
    tried = {function.__name__ for function, _ in GOOD}
    assert {*dir(ip), *tsid.__all__} <= tried | OTHERS


@pytest.mark.parametrize(("function", "good", "name"), _parameters())
def test_no_parameter_takes_an_odd_value(function: Callable[..., Any], good: dict[str, Any], name: str) -> None:
    for odd in (Odd(), [Odd()], {"a": 1}, b"x"):
        with pytest.raises(ip.ImpactPostureError) as caught:
            function(**{**good, name: odd})
        assert "\n" not in caught.value.line
        assert caught.value.hint
        assert caught.value.where == name, caught.value.line


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda: ip.ImpactContact(3, (0, 0, 1)), "frame: is 3; give text"),  # type: ignore[arg-type]
        (lambda: ip.ImpactContact("ee", (0, 0, 0)), "normal: is (0, 0, 0); give three finite numbers, not all zero"),
        (lambda: ip.ImpactContact("ee", (0, 0, 1), normal_frame="body"), "'body' is not one of world, contact"),  # type: ignore[arg-type]
        (lambda: ip.ImpactContact("ee", (0, 0, 1), friction=float("nan")), "friction: is nan; give 0 to 1e+100"),
        (lambda: ip.Metric("mass"), "kind: 'mass' is not one of euclidean, kinetic, weighted"),  # type: ignore[arg-type]
        (lambda: ip.Metric("weighted"), "needs weights"),
        (lambda: ip.Metric("kinetic", (1.0,)), "takes no weights"),
        (lambda: ip.Metric("weighted", (1.0, float("nan"))), "weights: is (1.0, nan); give"),
        (lambda: ip.ImpactObjective(ROBOT, CONTACT, metric="Kinetic"), "did you mean kinetic?"),  # type: ignore[arg-type]
        (lambda: ip.ImpactObjective(ROBOT, CONTACT, metric=ip.Metric("weighted", (1.0,))), "has 1 entries; give 9"),
        (lambda: ip.ImpactObjective(ROBOT, CONTACT, compliance=-1.0), "compliance: is -1.0"),
        (lambda: ip.ImpactObjective(ROBOT, CONTACT, others=[None]), "others: is [None]"),  # type: ignore[list-item]
        (lambda: ip.load_robot(5), "robot: is 5; give text"),  # type: ignore[arg-type]
        (lambda: ip.optimize(PROBLEM, starts="a"), "starts: is 'a'; give a whole number"),  # type: ignore[arg-type]
        (lambda: ip.optimize(PROBLEM, starts=True), "starts: is True; give a whole number"),
        (lambda: ip.optimize(PROBLEM, compile="alwys"), "did you mean always?"),  # type: ignore[arg-type]
        (lambda: ip.ImpactContact("ee", (0, 0, 1), (0, 0)), "offset: is (0, 0); give three finite numbers"),  # type: ignore[arg-type]
        (lambda: RESULT.save(3), "out: is 3; give text or Path"),  # type: ignore[arg-type]
        (lambda: RESULT.save("out", force="no"), "force: is 'no'; give True or False"),  # type: ignore[arg-type]
        (lambda: ip.ImpactObjective(ROBOT, CONTACT, supports="ee"), "a list of text or Support or None"),
        (lambda: ip.PostureProblem(OBJECTIVE, starts="a"), "PostureProblem: key 'starts'"),
        (lambda: ip.optimize(PROBLEM, starts=0), "starts: is 0; give a whole number, 1 or more"),
        (lambda: ip.ImpactContact("ee", (0, 0, 1), np.array(0.5)), "offset: "),  # type: ignore[arg-type]
        (lambda: ip.ImpactContact("ee", (10**400, 0, 1)), "normal: is "),
        (lambda: OBJECTIVE.evaluate(ROBOT.posture(), speed=10**400), "speed: is "),
        (lambda: ip.PostureProblem(OBJECTIVE, posture=np.array(0.5)), "posture: is "),
        (lambda: ip.PostureProblem(OBJECTIVE, posture={0.1, 0.2}), "posture: is "),  # type: ignore[arg-type]
        (lambda: ip.Metric("weighted", np.array([1.0, -2.0])), "weights: is "),  # type: ignore[arg-type]
    ],
)
def test_the_line_says_what_to_give(call: Callable[[], Any], line: str) -> None:
    with pytest.raises(ip.ImpactPostureError) as caught:
        call()
    assert line in caught.value.line


def test_what_fits_passes() -> None:
    """NumPy numbers and arrays are valid, also for parameters whose type is imported only for type checking."""

    @checked
    def function(
        count: int, share: float, on: bool, pair: tuple[float, float], names: dict[str, int], late: PostureSolution
    ) -> int:
        return count

    late = object.__new__(PostureSolution)
    assert function(np.int64(3), np.float32(1), np.True_, np.zeros(2), {}, late) == 3  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"late: is .*; give PostureSolution"):
        function(1, 1, True, (1, 2), {}, "x")  # type: ignore[arg-type]
    with pytest.raises(TypeError, match=r"missing a required argument|missing 1 required"):
        function(1, 1, True, (1, 2), {})  # type: ignore[call-arg]
    objective = ip.ImpactObjective(ROBOT, [CONTACT], compliance=np.float64(0), supports=np.array([], dtype=str))  # type: ignore[arg-type]
    assert ip.Metric("weighted", np.ones(2)) == ip.Metric("weighted", (1.0, 1.0))  # type: ignore[arg-type]
    assert ip.PostureProblem(objective, posture=list(ROBOT.posture())).problem.given.shape == (ROBOT.nq,)
