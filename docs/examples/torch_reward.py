"""The effective mass as a penalty for batched environments in PyTorch: tensors in, tensors out.

    pip install torch
    python torch_reward.py

A small policy learns to put the tool of an arm at random points, where it hits a wall along x.  Without the penalty,
any posture is good.  With the penalty, the policy chooses postures whose effective mass is small.  The penalty is
differentiable, so the policy is trained by backpropagation.  Under ``torch.no_grad()``, the same function is a reward
for other methods.  The file ``rail_arm_mjcf/rail_arm.xml`` must be in the folder of this program.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path

import torch

import impact_posture as ip

MJCF = Path(__file__).parent / "rail_arm_mjcf" / "rail_arm.xml"
# Axis of each joint after the rail, and distance along z from the joint before it; the last distance is to the tool.
AXES, OFFSETS = "zyyzyz", (0.1, 0.2, 0.4, 0.35, 0.1, 0.1, 0.1)
ROWS, RATE, WEIGHT = 512, 1e-2, 0.05  # environments; first learning rate; weight of the penalty
LOW, HIGH = torch.tensor([0.3, -0.4, 0.2]), torch.tensor([0.8, 0.4, 0.8])  # corners of the targets, m


def tool_position(q: torch.Tensor) -> torch.Tensor:
    """Return the position of the tool of the arm, shape (N, 3), for ``q`` of shape (N, 7)."""
    point = torch.zeros(len(q), 3, dtype=q.dtype)
    for k in reversed(range(len(AXES))):
        x, y, z = (point + torch.tensor([0, 0, OFFSETS[k + 1]], dtype=q.dtype)).unbind(1)
        c, s = torch.cos(q[:, k + 1]), torch.sin(q[:, k + 1])
        turned = (c * x - s * y, s * x + c * y, z) if AXES[k] == "z" else (c * x + s * z, y, c * z - s * x)
        point = torch.stack(turned, 1)
    return point + torch.stack([q[:, 0], torch.zeros(len(q), dtype=q.dtype), torch.full((len(q),), OFFSETS[0])], 1)


def impact_penalty(metric: ip.torch.TorchMetric, q: torch.Tensor) -> torch.Tensor:
    """Return ``log m(q)``, shape (N,): its gradient does not depend on the size of the robot."""
    return torch.log(metric.objective(q))


@dataclass(frozen=True)
class Outcome:
    """Median distance of the tool from its target, m, and median effective mass, kg, for new targets."""

    distance: float
    mass: float


def train(weight: float, steps: int = 500, seed: int = 0) -> Outcome:
    """Train a policy with a weight of the penalty, and return its outcome at new targets."""
    torch.manual_seed(seed)
    robot = ip.load_robot(str(MJCF))
    contact = ip.ImpactContact("tool", normal=(-1, 0, 0), friction=0.0)
    with tempfile.TemporaryDirectory() as folder:
        ip.ImpactObjective(robot, contact, kind="effective-mass").export(Path(folder) / "c")
        metric = ip.torch.load(Path(folder) / "c", robot=robot)
    low, high = (torch.tensor(limit) for limit in (robot.model.lowerPositionLimit, robot.model.upperPositionLimit))
    inner = torch.nn.Tanh(), torch.nn.Linear(64, 64), torch.nn.Tanh()
    policy = torch.nn.Sequential(torch.nn.Linear(3, 64), *inner, torch.nn.Linear(64, 7)).double()
    optimizer = torch.optim.Adam(policy.parameters(), RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)

    def act(targets: torch.Tensor) -> torch.Tensor:
        return low + (high - low) * torch.sigmoid(policy(targets))

    def targets() -> torch.Tensor:
        return (LOW + (HIGH - LOW) * torch.rand(ROWS, 3)).double()

    for _ in range(steps):
        goal = targets()
        q = act(goal)
        reward = -(tool_position(q) - goal).norm(dim=1) - weight * impact_penalty(metric, q)
        optimizer.zero_grad()
        (-reward.mean()).backward()
        optimizer.step()
        schedule.step()
    with torch.no_grad():
        goal = targets()
        q = act(goal)
        distance, mass = (tool_position(q) - goal).norm(dim=1), metric.objective(q)
    return Outcome(float(distance.median()), float(mass.median()))


def main() -> tuple[Outcome, Outcome]:
    """Train without and with the penalty, and print the results."""
    outcomes = train(0.0), train(WEIGHT)
    for outcome, words in zip(outcomes, ("without the penalty", "with the penalty"), strict=True):
        print(f"{words}: {1000 * outcome.distance:.0f} mm from the target, effective mass {outcome.mass:.3g} kg")
    return outcomes


if __name__ == "__main__":
    main()
