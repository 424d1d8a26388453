"""Compare the verdicts of a sweep with ``optimize``: ``python -m docs.studies.sweep_verdicts``.

A sweep with 4 starts solves a grid of targets, and ``optimize`` with 16 starts solves each point alone.  If only one
of the two methods certifies a point, the other method has missed it.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from itertools import product
from pathlib import Path

from impact_posture.config.problem_settings import ProblemSettings
from impact_posture.dynamics.numeric import Numeric
from impact_posture.errors import ImpactPostureError
from impact_posture.impact.impact_contact import point_on
from impact_posture.posture.formulation.problem_file import prepare
from impact_posture.posture.search.multistart import solve
from impact_posture.robot.robot_loader import load_robot
from impact_posture.sweep.atlas import open_atlas
from impact_posture.sweep.sweep_file import read_sweep
from impact_posture.sweep.sweep_run import run_sweep

# For each grid: robot, number of points along each axis, and half the length of an axis, m.
GRIDS = (("xarm7", 5, 0.2), ("panda", 5, 0.3), ("ur5", 4, 0.3), ("kinova", 4, 0.3))
NORMAL = (-1.0, 0.0, 0.0)
# An optimum of the sweep is worse if its objective is higher by more than this share.
_WORSE = 0.02


def alone(robot: str, x: float, y: float) -> float | None:
    """Return the best objective of 16 starts, or ``None`` if no start is certified."""
    loaded = load_robot(robot)
    place = Numeric(loaded.model).at(loaded.posture()).placement(point_on(loaded, loaded.spec.contact.frame or ""))
    at = place.translation
    target = (float(at[0]) + x, float(at[1]) + y, float(at[2]))
    settings = ProblemSettings(robot=robot, frame=loaded.spec.contact.frame or "", normal=NORMAL,
                               target_position=target)  # fmt: skip
    try:
        return solve(prepare(settings).problem, jobs=1, compile="never").optima[0].objective
    except ImpactPostureError:
        return None


def compared(robot: str, count: int, half: float, folder: Path) -> Iterator[str]:
    """Yield one line for the robot and one line for each false verdict."""
    axis = [-half + 2 * half * k / (count - 1) for k in range(count)]
    file = folder / f"{robot}.toml"
    file.write_text(
        f'[problem]\nrobot = "{robot}"\nnormal = {list(NORMAL)}\nstarts = 4\n[grid]\nx = {axis}\ny = {axis}\n'
    )
    began = time.process_time()
    run_sweep(read_sweep(file), folder / robot)
    spent, began = time.process_time() - began, time.process_time()
    rows = open_atlas(folder / robot).to_table().sort_by("point").to_pylist()
    known = [alone(robot, x, y) for x, y in product(axis, axis)]
    ratio = (time.process_time() - began) / spent
    pairs = list(zip(rows, known, strict=True))
    certified = [row["status"] == "certified" for row in rows]
    false = [(row, best) for row, best in pairs if row["status"] != "certified" and best is not None]
    new = sum(best is None for fine, best in zip(certified, known, strict=True) if fine)
    worse = sum(row["value"] > (1 + _WORSE) * best for row, best in pairs if row["value"] and best)
    yield (
        f"{robot}: {sum(certified)} of {len(rows)} points certified by the sweep, {len(false)} missed, {new} that "
        f"optimize misses; {worse} at a worse optimum; optimize took {ratio:.1f} times as long"
    )
    for row, best in false:
        yield f"  x = {row['x']:+.3f}, y = {row['y']:+.3f}: {row['status']} ({row['reason']}), but {best:.4g}"


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        for case in [case for case in GRIDS if case[0] in sys.argv[1:] or not sys.argv[1:]]:
            for line in compared(*case, Path(place)):
                print(line, flush=True)
