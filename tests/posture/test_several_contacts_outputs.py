"""Several contacts at once in the C export and on the command line."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from impact_posture.codegen.c_literals import DOUBLE, FLOAT, Real
from impact_posture.codegen.export import export
from impact_posture.codegen.impact_gradient import ImpactGradient
from impact_posture.codegen.self_test import sample_postures
from impact_posture.config.problem_settings import LoadOptions
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import Metric
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot_loader import load_robot
from impact_posture.system.libraries import build_library, library_path
from tests.impact.test_several_contacts import HANDS
from tests.support.command import run, succeed
from tests.support.helpers import assert_close, robot
from tests.support.tools import need, need_compiler

# ---- the C export -------------------------------------------------------------------------------------------------


@pytest.mark.long(but=("panda, float",))
@pytest.mark.parametrize(
    ("name", "hands", "real"),
    [("talos", HANDS, DOUBLE), ("panda", ("panda_hand_tcp", "panda_link4"), FLOAT)],
    ids=["talos, double", "panda, float"],
)
def test_exported_hands(tmp_path: Path, name: str, hands: tuple[str, str], real: Real) -> None:
    need_compiler()
    # Legs and torso are locked: this halves the code to compile, and the hands do not move.
    legs = tuple(joint for joint in robot(name).joint_names if joint.startswith(("leg", "head", "gripper", "torso")))
    locked_robot = load_robot(name, LoadOptions(lock=legs))
    right, left = (ImpactContact(frame, (-1.0, 0.1, 0.0), impulse=i) for frame, i in zip(hands, (1, 3), strict=True))
    objective = WorstCaseObjective(locked_robot, right, others=(left,))
    written = export(objective, tmp_path, prefix="hands", real=real, check=False)
    assert written.manifest["several"]["symbols"] == {
        "objective": "hands_objective", "objective_batch": "hands_objective_batch",
    }  # fmt: skip
    assert [b["frame"] for b in written.manifest["several"]["contacts"]] == list(hands)
    build_library(tmp_path, "hands", library_path(tmp_path, "hands"), ("-O0",))
    both = ImpactGradient.load(tmp_path, robot=locked_robot)
    alone = ImpactGradient.load(tmp_path, robot=locked_robot, frame=hands[1])
    tolerance = 1e-8 if real is DOUBLE else 1e-4
    for q in sample_postures(locked_robot, 5, 1):
        value, gradient = both.objective(q)
        assert_close(value, objective.value(q), tolerance, "value")
        assert_close(gradient, objective.gradient(q), tolerance, "gradient", scale=value)
        # For either frame, the problem's objective covers both contacts.
        assert alone.objective(q)[0] == value
        single = objective.singles[1]
        H, _ = alone.value_and_gradient(q, single.contact.normal)
        assert_close(9 * H, single.value(q), tolerance, "one hand alone")


def test_exported_frame_struck_along_two_normals(tmp_path: Path) -> None:
    make = need("make")
    need_compiler()
    biped = robot("bolt")
    feet = biped.spec.supports
    contacts = [ImpactContact("base_link", n, impulse=i) for n, i in (((0, 0, 1), 1.0), ((1, 0, 0.2), 2.0))]
    objective = WorstCaseObjective(
        biped, contacts[0], Metric("kinetic"), supports=feet, others=(contacts[1],), bilateral=True
    )
    export(objective, tmp_path, prefix="corner", check=False)
    assert "|impulse| up to" in (tmp_path / "corner.h").read_text()
    flags = "CFLAGS=-O0 -fPIC -Wall -Wextra -Werror"
    done = subprocess.run([make, "-s", "check", flags], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "agrees" in done.stdout
    build_library(tmp_path, "corner", library_path(tmp_path, "corner"), ("-O0",))
    loaded = ImpactGradient.load(tmp_path, robot=biped)
    for q in sample_postures(biped, 10, 2):
        value, gradient = loaded.objective(q)
        assert_close(value, objective.value(q), 1e-8, "value")
        assert_close(gradient, objective.gradient(q), 1e-7, "gradient", scale=value)


# ---- the command line ---------------------------------------------------------------------------------------------

BOTH = ("--contact", "panda_hand_tcp:0,0,1", "--contact", "panda_link4:1,0,0:2")


def test_json(tmp_path: Path) -> None:
    done = succeed("evaluate", "panda", *BOTH, "--json", cwd=tmp_path)
    document = json.loads(done.stdout)
    assert [c["frame"] for c in document["contacts"]] == ["panda_hand_tcp", "panda_link4"]
    assert [c["impulse_bound"] for c in document["contacts"]] == [1.0, 2.0]
    worst = document["evaluation"]["worst_impulses"]
    assert set(worst) == {"impulses", "tied", "corners", "jump_norm"} and worst["impulses"] in worst["corners"]
    assert worst["jump_norm"] ** 2 == pytest.approx(document["evaluation"]["objective"], rel=1e-9)


def test_evaluate_tells_contacts_of_one_frame_apart(tmp_path: Path) -> None:
    hand = "left_rubber_hand"
    struck = ("--contact", f"{hand}:-1,0,0", "--contact", f"{hand}:0,0,1", "--contact", "right_rubber_hand:-1,0,0:2")
    done = succeed("evaluate", "g1", *struck, "--bilateral", cwd=tmp_path)
    lines = done.stdout.splitlines()
    assert max(map(len, lines)) <= 80
    for name in (f"{hand} (-1, 0, 0)", f"{hand} (0, 0, 1)", "right_rubber_hand"):
        (row,) = [line for line in lines if line.startswith(f"  {name} ") and not line.rstrip().endswith(")")]
        assert len(row.removeprefix(f"  {name}").split()) == 4, "H, G, V, S in one row"
        assert any(f"(impact at {name})" in line for line in lines), "feet under each impact"
    assert "of an impact at" in done.stdout and "alone" in done.stdout


def test_bad_input(tmp_path: Path) -> None:
    for arguments, code, text in (
        (("--contact", "panda_hand:0,0"), 2, "is not a contact"),
        (("--contact", "panda_hand:0,0,0"), 2, "with a direction"),
        (("--contact", "panda_hand:0,0,1:-1"), 2, "impulse above zero"),
        ((*BOTH, "--normal", 0, 0, 1), 2, "replaces --frame and --normal"),
        ((*BOTH, "--objective", "speed"), 1, "approach speed of one contact"),
    ):
        done = run("evaluate", "panda", *arguments, cwd=tmp_path)
        assert done.returncode == code and "Traceback" not in done.stderr
        assert text in " ".join(done.stderr.split())
