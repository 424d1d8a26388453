"""Optimizations whose results are committed, each defined by one command."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path

from impact_posture.config.problem_settings import SCREENED, ProblemSettings
from impact_posture.posture.formulation.problem_file import Prepared, prepare
from impact_posture.posture.search.multistart import PostureSolution, solve
from tests.support.settings import make_settings

ROOT = Path(__file__).parents[2]
EXPECTED = Path(__file__).with_name("expected.json")
PAGE = ROOT / "docs" / "generated" / "regression.md"


@dataclass(frozen=True)
class Case:
    """Optimization whose result is committed.

    Attributes:
        name: Key of the result in ``expected.json``.
        robot: Robot name, or URDF path relative to the repository.
        frame: Contact frame.
        normal: Contact normal in the world frame.
        many: If true, there are so many optima that rounding decides which optimum the command returns.
    """

    name: str
    robot: str
    frame: str
    normal: tuple[float, float, float]
    many: bool = False

    @property
    def command(self) -> str:
        """Command that a user types for this optimization."""
        normal = " ".join(f"{v:g}" for v in self.normal)
        return f"impact-posture optimize {shlex.quote(self.robot)} --frame {self.frame} --normal {normal}"

    @property
    def settings(self) -> ProblemSettings:
        robot = str(ROOT / self.robot) if self.robot.endswith(".urdf") else self.robot
        return make_settings(
            {"robot": robot, "frame": self.frame, "normal": self.normal, "collision": True, "holdable": True}
        )

    def solve(self) -> tuple[Prepared, PostureSolution]:
        prepared = prepare(self.settings)
        settings = prepared.settings
        return prepared, solve(prepared.problem, seed=settings.seed, screened=SCREENED)


CASES = (
    Case("tilthex_arm, floor", "tilthex_arm", "ee", (0, 0, 1)),
    Case("tilthex_arm, wall", "tilthex_arm", "ee", (-1, 0, 0)),
    Case("solo8, push at the base", "solo8", "base_link", (1, 0, 0)),
    Case("talos, push at the torso", "talos", "torso_2_link", (1, 0, 0), many=True),
    Case("talos, right hand", "talos", "gripper_right_base_link", (-1, 0, 0), many=True),
    Case("panda, hand", "panda", "panda_hand_tcp", (0, 0, 1)),
    Case("hextilt, gripper", "hextilt", "flying_arm_5__gripper", (0, 0, 1)),
    Case("rail_arm, your own URDF", "docs/examples/rail_arm/rail_arm.urdf", "tool", (0, 0, 1)),
)
