"""Optimize a posture of every available robot model from its bare file, each model in a separate process.

``python -m docs.studies.robots SOURCE STARTS SEED`` runs one robot and prints its row as JSON.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pinocchio as pin

from docs.studies.core import ROOT, Request, machine, say, table
from impact_posture.collision.robot_shapes import shape_warnings
from impact_posture.config.problem_settings import LoadOptions, ProblemSettings
from impact_posture.config.table_validation import validate
from impact_posture.draft.draft import write_draft
from impact_posture.errors import ImpactPostureError
from impact_posture.posture.analysis.result_document import result_document
from impact_posture.posture.formulation.problem_file import Prepared, prepare
from impact_posture.posture.search.multistart import solve
from impact_posture.posture.search.singular_target import singular_target
from impact_posture.robot.model_joints import q_slice
from impact_posture.robot.posture_files import read_posture, write_posture
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_summary import summarize
from impact_posture.robot.urdf import EXAMPLE_PREFIX, example_models, example_robot_data
from impact_posture.system.escape import toml

# Wall time of one robot, s.
LIMIT = 600
# Largest violation of a constraint by the posture that was read.
_VIOLATION = 1e-6
# Largest difference of the objective after the posture was read, relative to the objective at the start.
_SAME = 1e-9
# Shortest distance (m) of a joint from the contact point that gives the direction of a link.
_SHORT = 0.05
# Packages with MJCFs of robots → the folder of these robots in the package.
_PACKAGES = {"robosuite": "models/assets/robots", "robosuite_models": "assets/robots"}
_HEAD = ("model", "joints", "contact", "start", "normal", "objective", "optimum", "left", "s", "outcome")


def sources() -> dict[str, str]:
    """Return the available models: name → path or URI.

    These are example-robot-data, the packages of robots that are installed, and the robots of MuJoCo Menagerie that
    are already downloaded, or all of them if ``MENAGERIE_ROOT`` is a clone.
    """
    models = {path: EXAMPLE_PREFIX + path for path in example_models()}
    for package, folder in _PACKAGES.items():
        spec = find_spec(package)
        for root in map(Path, spec.submodule_search_locations or () if spec else ()):
            files = sorted((root / folder).glob("*/robot.xml"))
            models |= {f"{package}/{path.parent.name}": str(path) for path in files}
    with suppress(ImportError):
        menagerie = import_module("mujoco_menagerie")
        cache = menagerie.Cache()
        known = (name for name in menagerie.names() if cache.root or cache.is_cached(menagerie.get(name)))
        models |= {f"menagerie:{name}": f"menagerie:{name}" for name in known}
    return models


def lines(request: Request) -> Iterator[str]:
    """Yield a row for each model, then the counts of answers, refusals and faults."""
    yield "Each model is inspected, its `robot.toml` is drafted from the bare file, and the draft is used as it"
    yield "is: an impact at the drafted contact frame is optimized with all default constraints, from"
    yield f"{request.count} starts. A foot hits the ground. A base hits a wall ahead. Any other frame hits a wall to"
    yield "which the last link points. *joints*: number of joints, `f` with a floating base. *start*: default posture"
    yield "of the draft. If a fixed robot has no posture, the joints start in the `middle` of their ranges. If the"
    yield "robot is stretched there, it starts from the `bent` posture that the error for singular targets offers."
    yield "*left*: degrees of freedom that the constraints leave. An *answer* is certified, within"
    yield f"{_VIOLATION:g} of all constraints, not worse than the start, and gives the same objective after"
    yield "`posture.json` was written and read. A *refusal* is an error message of one line, which the row"
    yield f"contains. Anything else is a *fault*, for example a run of more than {LIMIT} s."
    yield machine()
    yield ""
    outcomes = Counter[str]()
    wanted = [(name, source) for name, source in sources().items() if request.only in name]
    with ThreadPoolExecutor(request.jobs) as pool:
        yield from table(_HEAD, _rows(pool.map(partial(_run, request=request), wanted), outcomes, request))
    yield ""
    yield f"{len(wanted)} models: {', '.join(f'{outcomes[k]} {k}s' for k in ('answer', 'refusal', 'fault'))}."


def _rows(results: Iterator[dict[str, str]], outcomes: Counter[str], request: Request) -> Iterator[list[str]]:
    for result in results:
        outcomes[result["outcome"]] += 1
        if result["outcome"] == "fault":
            request.missed.append(f"{result['model']}: {result['why']}")
        why = result.get("why", "").replace("|", "/")
        yield [*(result.get(key, "–") for key in _HEAD[:-1]), f"{result['outcome']}{why and f': {why}'}"]


def _run(model: tuple[str, str], request: Request) -> dict[str, str]:
    """Run one model, given by name and source, in its own process and return its row."""
    name, source = model
    say(name)
    command = [sys.executable, "-m", "docs.studies.robots", source, str(request.count), str(request.seed)]
    began, row = time.monotonic(), {"model": name}
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=LIMIT, check=False)
    except subprocess.TimeoutExpired:
        return row | {"outcome": "fault", "why": f"more than {LIMIT} s"}
    row["s"] = f"{time.monotonic() - began:.0f}"
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or [f"exit {done.returncode}"])[-1]
        return row | {"outcome": "fault", "why": reason}
    result = json.loads(done.stdout)
    return row | result | {"why": result["why"].replace(source, name)}


def study(source: str, starts: int, seed: int, folder: Path) -> dict[str, str]:
    """Inspect, draft, evaluate and optimize one model; return the cells of its row."""
    row: dict[str, str] = {}
    try:
        config, _ = write_draft(source, LoadOptions(), folder / "draft.toml")
        robot = load_robot(source, LoadOptions(config=str(config)))
        json.dumps([summarize(robot), shape_warnings(robot)], allow_nan=False)
        row |= {
            "joints": f"{len(robot.joint_names)}{' f' * robot.floating}",
            "contact": str(robot.spec.contact.frame),
        }
        if robot.default_posture == "neutral" and (joints := _middle(robot)):
            _start_from(config, "middle", robot, joints)
        prepared = _prepared(source, config, seed)
        singular = singular_target(prepared.problem, [prepared.problem.given])
        if singular is not None and singular.bent:
            _start_from(config, "bent", prepared.impact.robot, singular.bent)
            prepared = _prepared(source, config, seed)
        impact, start = prepared.impact, prepared.impact.robot.default_posture
        row["normal"] = " ".join(f"{v:.2g}" for v in impact.contact.normal)
        row |= {"start": start, "objective": f"{impact.evaluate(prepared.problem.given).objective:.4g}"}
        solution = solve(prepared.problem, starts=starts, seed=seed, jobs=1, compile="never")
        json.dumps(result_document(prepared, solution), allow_nan=False)
        initial, optimum = (prepared.problem.objective.value(q) for q in (solution.initial, solution.q))
        row |= {"objective": f"{initial:.4g}", "optimum": f"{optimum:.4g}", "left": str(solution.redundancy)}
        path = folder / "posture.json"
        path.write_text(json.dumps(write_posture(impact.robot, solution.q)), encoding="utf-8")
        again = impact.evaluate(read_posture(impact.robot, str(path))).objective
    except ImpactPostureError as error:
        why = error.line.replace(f"{folder}/", "").replace(f"{example_robot_data()}/", EXAMPLE_PREFIX)
        return row | {"outcome": "refusal", "why": why}
    faults = {
        "the constraints are violated": not solution.certificate.primal <= _VIOLATION,
        "the optimum is worse than the start": not optimum <= (1 + _SAME) * initial,
        "the posture that was read has another objective": not abs(again - optimum) <= _SAME * initial,
    }
    why = ", ".join(fault for fault, holds in faults.items() if holds)
    return row | {"outcome": "fault" if why else "answer", "why": why}


def _prepared(source: str, config: Path, seed: int) -> Prepared:
    """Return the problem of an impact at the drafted contact frame, with the default constraints of ``optimize``."""
    normal = natural_normal(load_robot(source, LoadOptions(config=str(config))))
    values = {"robot": source, "config": str(config), "normal": normal, "seed": seed}
    return prepare(validate(ProblemSettings, values, "options"))


def _middle(robot: Robot) -> dict[str, float]:
    """Return the middle of the range of each joint of a fixed robot, without joints that can make a turn."""
    model, joints = robot.model, dict[str, float]()
    for name in robot.joint_names if not robot.floating else ():
        entries = q_slice(model, robot.joint_id(name))
        low, high = float(model.lowerPositionLimit[entries][0]), float(model.upperPositionLimit[entries][0])
        if entries.stop - entries.start == 1 and high - low < 2 * np.pi - _SHORT:
            joints[name] = round((low + high) / 2, 3)
    return joints


def _start_from(config: Path, name: str, robot: Robot, joints: dict[str, float]) -> None:
    """Add the default posture with other values of some joints to a draft, and make it the default posture."""
    stated = write_posture(robot, robot.posture())
    angles = {joint: value for joint, value in stated["joints"].items() if isinstance(value, float)} | joints
    base = [f"base = {toml(stated['base'])}"] if robot.floating else []
    posture = ["", f"[postures.{name}]", *base, f"joints = {toml(angles)}"]
    lines = [line for line in config.read_text(encoding="utf-8").splitlines() if "default_posture" not in line]
    config.write_text("\n".join([f'default_posture = "{name}"', *lines, *posture, ""]), encoding="utf-8")


def natural_normal(robot: Robot) -> tuple[float, ...]:
    """Return the normal: up for a foot, backwards for a base (a wall ahead), and otherwise opposite to the last link.

    The last link points from its joint to the contact point.  If this joint is too near, an earlier joint replaces
    it.
    """
    frame, model, data = str(robot.spec.contact.frame), robot.model, robot.model.createData()
    if frame in [support.frame for support in robot.spec.supports]:
        return 0.0, 0.0, 1.0
    index = robot.frame_id(frame)
    pin.framesForwardKinematics(model, data, robot.posture())
    point = data.oMf[index].act(np.array(robot.spec.contact.offset_of(frame)))
    joints = (j for j in reversed(model.supports[model.frames[index].parentJoint]) if j > int(robot.floating))
    links = (point - data.oMi[joint].translation for joint in joints)
    link = next((link for link in links if np.linalg.norm(link) > _SHORT), np.eye(3)[0])
    return tuple((0.0 - (link / np.linalg.norm(link)).round(3)).tolist())


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        print(json.dumps(study(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), Path(scratch))))
