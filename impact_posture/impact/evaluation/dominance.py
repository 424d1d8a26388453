"""Share of each joint in the squared velocity jump ``H``."""

from __future__ import annotations

from dataclasses import dataclass

from impact_posture.config.json_block import JsonBlock
from impact_posture.impact.evaluation.impact_effect import tangent_units
from impact_posture.impact.quantities.impact_quantities import ImpactQuantities
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.model_joints import v_slice


@dataclass(frozen=True)
class Dominance(JsonBlock):
    """Whether one light joint makes up most of ``H``.

    Attributes:
        joint: The joint with the largest share.
        share: Share of this joint in ``H = Σ a_i (Wa)_i``, 0 to 1.
        base: Share of the floating base in ``H``; zero for a fixed base.
        line: Explanation for users.
    """

    joint: str
    share: float
    base: float
    line: str
    derived = ("dominates",)

    @property
    def dominates(self) -> bool:
        """Whether the largest share is above one half."""
        return self.share > 0.5


def find_dominance(objective: WorstCaseObjective, quantities: ImpactQuantities) -> Dominance:
    """Return the joint with the largest share of ``H``: ``Σ a_i (Wa)_i / H`` over the entries of the joint."""
    robot, oracle = objective.robot, objective.oracle
    parts = quantities.jump * oracle.weigh(quantities.jump)
    width = robot.first_joint
    if quantities.H <= 0 or not robot.joint_names:
        return Dominance("", 0.0, float(quantities.H > 0), "no joint contributes to H")
    base = float(parts[:width].sum() / quantities.H)
    slots = {name: v_slice(robot.model, robot.joint_id(name)) for name in robot.joint_names}
    shares = {name: float(parts[slot].sum() / quantities.H) for name, slot in slots.items()}
    joint = max(shares, key=lambda name: shares[name])
    share, k = shares[joint], slots[joint].start
    percent = f"{100 * share:.0f} %"
    if share > 0.5:
        unit = "kg" if tangent_units(robot)[k] == "m/s" else "kg·m²"
        line = (
            f"joint '{joint}' contributes {percent} of H (armature {robot.model.armature[k]:.3g} of the "
            f"{oracle.M[k, k]:.3g} {unit} that it moves)"
        )
        if objective.metric.kind != "kinetic":
            rest = ", and the rest of the robot hardly affects H" if share > 0.9 else ""
            line += f"{rest}; compare with `metric` kinetic"
    elif base > 0.5:
        line = f"no single joint dominates H (base: {100 * base:.0f} %; largest joint: '{joint}', {percent})"
    else:
        line = f"no single joint dominates H (largest: '{joint}', {percent})"
    return Dominance(joint, share, base, line)
