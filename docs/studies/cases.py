"""Problems that the studies measure, by name."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.program.constrained_problem import ConstrainedProblem
from tests.support.settings import make_settings

DOWN, AHEAD, ASIDE, BACK = (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)
_HANDS = ("gripper_left_base_link:-1,0,0", "gripper_right_base_link:-1,0,0")
_STRUCK = {"contact": ("FL_FOOT:0,0,1", "HR_FOOT:0,0,1"), "support": ("FR_FOOT", "HL_FOOT")}


@dataclass(frozen=True)
class Case:
    """Problem for ``impact-posture optimize``, with a name.

    Attributes:
        name: Name of the case in the tables.
        robot: Name of a robot from ``impact-posture robots``.
        normal: Contact normal in the world; ``None`` if ``more`` contains the contacts.
        more: Further keys of ``problem.toml``.
    """

    name: str
    robot: str
    normal: tuple[float, float, float] | None
    more: Mapping[str, object] = field(default_factory=dict)

    def problem(self, **more: object) -> ConstrainedProblem:
        """Build the problem.

        The robot provides the contact frame and the supports, unless ``more`` contains others.
        """
        values = {"robot": self.robot, "normal": self.normal, **self.more, **more}
        return prepare(make_settings(values)).problem


_ALL = (
    Case("tilthex_arm", "tilthex_arm", DOWN),
    Case("tilthex_arm, ahead", "tilthex_arm", AHEAD),
    Case("panda", "panda", DOWN),
    Case("solo8, four feet", "solo8", AHEAD),
    Case("talos, two feet", "talos", AHEAD),
    Case("tilthex_arm, cone 5°", "tilthex_arm", DOWN, {"normal_cone": 5.0}),
    Case("tilthex_arm, cone 20°", "tilthex_arm", DOWN, {"normal_cone": 20.0}),
    Case("tilthex_arm, cone 45°", "tilthex_arm", DOWN, {"normal_cone": 45.0}),
    Case("solo8, four feet, cone 20°", "solo8", AHEAD, {"normal_cone": 20.0}),
    Case("talos, two feet, cone 5°", "talos", AHEAD, {"normal_cone": 5.0}),
    Case("talos, two feet, cone 20°", "talos", AHEAD, {"normal_cone": 20.0}),
    Case("talos at the torso, two feet, cone 20°", "talos", AHEAD, {"frame": "torso_2_link", "normal_cone": 20.0}),
    Case("talos, both hands", "talos", None, {"contact": _HANDS}),
    Case("solo12, two feet struck", "solo12", None, _STRUCK),
    Case("tilthex_arm, 6 models", "tilthex_arm", DOWN, {"armature_range": (0.5, 2.0), "payload": (("ee", 0.3),)}),
    Case("talos, two feet, 3 models", "talos", AHEAD, {"armature_range": (0.5, 2.0)}),
    Case("talos at the torso", "talos", AHEAD, {"frame": "torso_2_link"}),
    Case("solo8, aside", "solo8", ASIDE),
    Case("solo12", "solo12", AHEAD),
    Case("bolt", "bolt", AHEAD),
    Case("g1", "g1", AHEAD),
    Case("tilthex_arm, wall", "tilthex_arm", BACK),
    Case("talos, wall", "talos", BACK),
    Case("solo12, wall", "solo12", BACK),
    Case("hextilt, wall", "hextilt", BACK),
)  # fmt: skip
CASES = {case.name: case for case in _ALL}


def cases(only: str, names: Iterator[str] | None = None) -> list[Case]:
    """Return the cases among ``names`` (by default all cases) whose name contains ``only``."""
    return [CASES[name] for name in (names or CASES) if only in name]
