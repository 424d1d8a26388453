"""Study of recorded hits, on hits that the test writes: reading, fitting, predicting, and damaged files."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from docs.studies.__main__ import main
from docs.studies.core import Request, page_of
from docs.studies.hits.arm import MASSES, MODELS, URDF, Arm, with_box
from docs.studies.hits.figure import PICTURE, figure
from docs.studies.hits.fit import Fit, summary
from docs.studies.hits.recordings import PERIOD, SOURCE, Group, Hit, by_group, contact_row, read_hits
from docs.studies.hits.study import AT_TIP, FITTED, LINKS, PER_BOX, REPEAT, Evaluation, lines
from impact_posture.errors import InputError
from tests.support.helpers import Vector, assert_close, rng

TRUE = Arm(-1.2, 0.02, np.array([0.7, 0.9, 0.6, 0.4, 0.3, 0.11, 0.2]), (0.02, -0.05))
RESTITUTION = 0.8
# Two postures in which the tool points along +y, and joint velocities that move it along +y.
POSTURES = {1: [-0.2, 1.1, 0.5, -1.6, -1.8, -1.1, -1.0], 2: [-0.8, 1.4, 1.0, -1.45, -2.7, -1.1, -0.5]}
RATES = {1: [1.1, -0.2, 1.4, -0.2, 0.5, 2.8, 0.3], 2: [0.85, 0.0, 1.4, -1.7, -1.1, 3.3, 1.5]}
ROWS, CONTACT = 28, 8


def rows_of(group: Group, generator: np.random.Generator) -> dict[str, Vector]:
    """Simulate a hit of the model ``reflected``.  Each torque sensor shows the impulse on its rotor."""
    q0, v0 = (np.array(values[group.posture]) + 1e-3 * generator.normal(size=7) for values in (POSTURES, RATES))
    t = PERIOD * np.arange(ROWS)[:, None]
    acceleration = np.array([2.0, 1.0, 1.5, 4.0, -2.0, 1.0, 3.0])
    trend = q0 + v0 * t + acceleration * t**2 / 2
    before = v0 + acceleration * t[CONTACT - 1]
    jump = (1 + RESTITUTION) * (TRUE.approach(trend[CONTACT]) @ before) * own_jump(TRUE, group.box, trend[CONTACT])
    lost = np.zeros((ROWS, 7))
    lost[CONTACT : CONTACT + 2] = -TRUE.rotors * jump / (2 * PERIOD)
    model = replace(TRUE, rotors=np.zeros(7)).robot(1.0).model  # the sensors do not measure the torque on the rotors
    data = model.createData()
    motions = [(with_box(x) for x in (trend[k], v0 + acceleration * t[k], acceleration)) for k in range(CONTACT)]
    carried = np.array([pin.rnea(model, data, *motion)[:7] for motion in motions])
    torque = np.vstack([carried, np.tile(carried.mean(axis=0), (ROWS - CONTACT, 1))]) + lost
    command = torque - lost - carried.mean(axis=0) + 5.0
    command[CONTACT + 12 :, 0] = -60.0
    q = trend - integral(integral(lost)) / TRUE.rotors
    return {"t": t[:, 0] + 100.0, "q": q, "dq": np.gradient(q, PERIOD, axis=0), "effort": -torque, "command": command}


def integral(values: Vector) -> Vector:
    return np.vstack([np.zeros((1, 7)), np.cumsum(PERIOD * (values[1:] + values[:-1]) / 2, axis=0)])


def own_jump(arm: Arm, box: int, q: Vector) -> Vector:
    """Return the plastic jump per approach speed, computed with Pinocchio alone."""
    model = pin.buildModelFromUrdf(str(URDF))
    link = model.inertias[7]
    mass = link.mass + arm.mass
    center = (link.mass * link.lever + np.array([0, 0, arm.moment])) / mass
    model.inertias[7] = pin.Inertia(mass, center, link.inertia * mass / link.mass)
    data, q = model.createData(), np.append(q, np.zeros(3))
    M = pin.crba(model, data, q)[:7, :7]
    M = np.triu(M) + np.triu(M, 1).T + np.diag(arm.rotors)
    point = pin.SE3(np.eye(3), np.array([*arm.offset, 0.0]))
    tip = pin.computeFrameJacobian(model, data, q, model.getFrameId("tip"), pin.ReferenceFrame.LOCAL)
    j = (point.actionInverse @ tip)[2, :7]
    response = np.linalg.solve(M, j)
    return -response / (j @ response + 1 / MASSES[box])


def write_window(folder: Path, name: str, group: Group, rows: dict[str, Vector]) -> Path:
    keys = {"t": "t", "q": "q", "dq": "dq", "effort": "tau", "command": "tau_cmd"}
    listed = [{key: rows[own][k].tolist() for own, key in keys.items()} for k in range(ROWS)]
    source = f"50_hits-config_{group.posture}-object_{group.box}/IIWA_7_{name}.csv"
    path = folder / f"{group.posture}_{group.box}_{name}.json"
    path.write_text(json.dumps({"source": source, "contact_row_approx": CONTACT, "rows": listed}), encoding="utf-8")
    return path


def write_csv(folder: Path, name: str, group: Group, rows: dict[str, Vector]) -> Path:
    place = folder / f"50_hits-config_{group.posture}-object_{group.box}"
    place.mkdir(exist_ok=True)
    head = "RobotName,RosTime,JointPosition,JointVelocity,JointEffort,TorqueCmd,HittingFlux"
    text = ["DesiredFlux,1,HitTime,100.1,DesiredPos,0.5 0.3  0.2", head]
    for k in range(ROWS):
        vectors = ["  ".join(map(repr, rows[key][k].tolist())) for key in ("q", "dq", "effort", "command")]
        text.append(f"IIWA_7,{rows['t'][k].item()!r}, {','.join(vectors)},0.1")
    path = place / f"IIWA_7_{name}.csv"
    path.write_text("\n".join(text) + "\n", encoding="utf-8")
    return path


def write_hits(folder: Path, write: Callable[[Path, str, Group, dict[str, Vector]], Path]) -> Path:
    folder.mkdir()
    for group in (Group(posture, box) for posture in (1, 2) for box in (1, 2)):
        for k in range(3):
            write(folder, f"hit_{k}", group, rows_of(group, rng("hits", str(group), k)))
    return folder


@pytest.fixture(scope="module")
def windows(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_hits(tmp_path_factory.mktemp("hits") / "windows", write_window)


@pytest.fixture(scope="module")
def evaluation(groups: dict[Group, list[Hit]]) -> Evaluation:
    return Evaluation(groups)


@pytest.fixture(scope="module")
def groups(windows: Path) -> dict[Group, list[Hit]]:
    return dict(by_group(read_hits(windows)[0]))


def test_csv_files_and_windows_give_the_same_hits(windows: Path, tmp_path: Path) -> None:
    (hits, left), (others, none) = read_hits(windows), read_hits(write_hits(tmp_path / "csv", write_csv))
    assert left == none == [] and len(hits) == len(others) == 12
    for group, own in by_group(hits):
        for hit, other in zip(own, dict(by_group(others))[group], strict=True):
            shift = hit.contact - other.contact
            kept = slice(shift, shift + len(other.q))
            assert other.contact < hit.contact
            for name in ("q", "dq", "torque", "command"):
                np.testing.assert_array_equal(getattr(hit, name)[kept], getattr(other, name))


def test_the_contact_row_needs_a_braking_controller_and_a_jump_of_the_torques() -> None:
    rows = rows_of(FITTED, rng("row"))
    assert contact_row(rows["effort"], rows["command"]) == CONTACT
    smooth = np.tile(rows["effort"][:1], (ROWS, 1))
    assert contact_row(smooth, rows["command"]) is None
    smooth[:, 1] = rows["effort"][:, 1]
    assert contact_row(smooth, rows["command"]) is None
    assert contact_row(rows["effort"][:5], rows["command"][:5]) is None


def test_the_fit_recovers_what_made_the_hits(evaluation: Evaluation) -> None:
    fit = evaluation.fit
    assert fit.arm.mass == pytest.approx(TRUE.mass, abs=0.01)
    assert fit.arm.moment == pytest.approx(TRUE.moment, abs=0.002)
    assert_close(fit.arm.rotors, TRUE.rotors, 0.001, "rotors")
    fitted = fit.models["reflected"]
    assert_close(fitted.arm.offset, TRUE.offset, 0.02, "contact point")
    assert fitted.gain - 1 == pytest.approx(RESTITUTION, abs=0.01)


def test_the_true_model_predicts_the_other_groups(evaluation: Evaluation) -> None:
    for group in evaluation.measured:
        score = evaluation.scores[group, "reflected"]
        assert score.error < 0.01 and score.cosine > 0.9999
        assert score.loss == pytest.approx(1, abs=0.01) and score.size == pytest.approx(1, abs=0.01)
        assert all(evaluation.scores[group, name].error > 0.2 for name in (LINKS, AT_TIP, "link"))
        assert (evaluation.scores[group, REPEAT].error < 1e-9) == (group == FITTED)
        assert ((group, PER_BOX) in evaluation.scores) == (group.posture == 2)
        from_torques, predicted, mass = evaluation.impulses(group)
        assert from_torques == pytest.approx(predicted, rel=0.03)
        assert mass == pytest.approx(MASSES[group.box], rel=0.06)


def test_the_jumps_as_recorded_contain_trend_and_controller(groups: dict[Group, list[Hit]]) -> None:
    hit = groups[FITTED][0]
    pushed = replace(hit, command=hit.command + np.arange(ROWS)[:, None] * (np.arange(ROWS)[:, None] >= CONTACT))
    plain = Fit([hit])
    other = summary([pushed], plain.arm)
    # The torque of the controller grows and moves the joints forward, so the contact must have slowed them more.
    share = plain.arm.inertia(hit.q[hit.contact]) @ (plain.measured.jump - other.jump)
    np.testing.assert_allclose(share, PERIOD * sum(range(CONTACT, CONTACT + 7)), rtol=1e-9)
    np.testing.assert_allclose(plain.measured.relative, other.relative)
    recorded = Fit([hit], recorded=True).measured.jump
    trend = hit.trend()[1] * PERIOD * 7  # from the last interval before the contact to the middle of AVERAGED
    assert_close(recorded - plain.measured.relative, trend, 0.01, "trend")


@pytest.mark.parametrize("box", [1, 2])
def test_the_models_agree_with_pinocchio(box: int) -> None:
    for posture in POSTURES.values():
        q = np.array(posture)
        assert_close(MODELS["reflected"].jump(TRUE, MASSES[box], q), own_jump(TRUE, box, q), 1e-9, "reflected")
        links = replace(TRUE, rotors=np.zeros(7))
        assert_close(MODELS["link"].jump(TRUE, MASSES[box], q), own_jump(links, box, q), 1e-9, "link")
        stiff = replace(TRUE, stiffness=100.0)  # in a long contact, the rotors move with the links
        assert_close(MODELS["elastic"].jump(stiff, MASSES[box], q), own_jump(TRUE, box, q), 0.01, "elastic")


def test_friction_keeps_the_contact_point_from_sliding() -> None:
    q = np.array(POSTURES[1])
    jumps = [model.jump(TRUE, 1.9, q) for name, model in MODELS.items() if name.startswith("reflected")]
    assert np.linalg.norm(jumps[0] - jumps[1]) > 0.01 * np.linalg.norm(jumps[0])
    assert all(TRUE.approach(q) @ jump < 0 for jump in jumps)


def test_the_page_in_short(
    windows: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["studies", "hits", "--data", str(windows), "--count", "1"])
    assert main() == 0
    text = capsys.readouterr().out
    assert "3 (posture 1, heavy box)" in text
    heads = ("Fitted", "Loss of tip speed", "Joint jumps", "Order", "Which inertia", "Impulse", "Jump of each joint")
    assert all(f"### {head}" in text for head in heads)
    assert "nan" not in text
    assert sum(line.startswith("| posture") and "| reflected < " in line for line in text.splitlines()) == 4


def test_the_figure_has_every_hit(groups: dict[Group, list[Hit]], evaluation: Evaluation) -> None:
    drawing = figure(groups, evaluation)
    assert len(drawing.axes) == 16
    assert all(len(axes.lines) == 3 + 2 for axes in drawing.axes)


def test_without_recordings_one_line_says_where_they_are(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    page = page_of("hits").read_bytes()
    monkeypatch.setattr("sys.argv", ["studies", "hits", "--write"])
    assert main() == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and "epfl-lasa/air_hockey" in error and "DATA=" in error
    assert page_of("hits").read_bytes() == page


def damaged(path: Path) -> Iterator[tuple[str, str]]:
    """Yield a name and the text of each damaged version of a file."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".csv":
        yield "cut within a row", text[: len(text) // 2]
        yield "without a column", text.replace("JointEffort", "Effort")
        yield "without a header", "\n".join(text.splitlines()[2:])
        yield "with a word", text.replace("IIWA_7,100.0", "IIWA_7,soon", 1)
        yield "without rows", "\n".join(text.splitlines()[:2])
    else:
        window: dict[str, Any] = json.loads(text)
        yield "cut", text[: len(text) // 2]
        yield "a list", "[]"
        yield "without source", json.dumps({key: window[key] for key in ("contact_row_approx", "rows")})
        yield "without a contact", json.dumps({key: window[key] for key in ("source", "rows")})
        rows = [dict(row) for row in window["rows"]]
        yield "a contact that is text", json.dumps(window | {"contact_row_approx": "soon"})
        yield (
            "times that are text",
            json.dumps(window | {"rows": [dict(row) | {"t": "now"} for row in window["rows"]]}),
        )
        yield "short rows", json.dumps(window | {"rows": [row | {"q": row["q"][:6]} for row in rows]})
        yield "not finite", json.dumps(window | {"rows": [*rows[:-1], rows[-1] | {"tau": [float("nan")] * 7}]})
    yield "not text", "\0\1"


@pytest.mark.parametrize("write", [write_window, write_csv], ids=["window", "csv"])
def test_damaged_files_are_refused_by_name(
    write: Callable[[Path, str, Group, dict[str, Vector]], Path], tmp_path: Path
) -> None:
    path = write(tmp_path, "hit_1", FITTED, rows_of(FITTED, rng("damaged")))
    versions = list(damaged(path))
    for name, text in versions:
        path.write_text(text, encoding="utf-8")
        with pytest.raises(InputError) as caught:
            read_hits(tmp_path)
        assert path.name in str(caught.value) and "not a recording" in str(caught.value), name
    path.write_bytes(b"\xff\xfe\xfd")
    with pytest.raises(InputError, match="not a recording"):
        read_hits(tmp_path)


def test_hits_that_cannot_be_used_are_left_out_with_the_reason(tmp_path: Path) -> None:
    rows = rows_of(FITTED, rng("left out"))
    repeated = rows | {"q": np.vstack([rows["q"][:5], rows["q"][4:-1]])}
    skipped = rows | {"t": rows["t"] + 0.005 * (np.arange(ROWS) > 9)}
    good = write_window(tmp_path, "hit_0", FITTED, rows)
    write_window(tmp_path, "hit_1", FITTED, repeated)
    write_window(tmp_path, "hit_2", FITTED, skipped)
    window = json.loads(good.read_text(encoding="utf-8"))
    changes = {"hit_3": {"source": "config_1-object_2/D3/IIWA_7_hit_3.csv"}, "hit_4": {"contact_row_approx": 1}}
    changes |= {"hit_5": {"contact_row_approx": None}, "hit_6": {"contact_row_approx": ROWS - 5}}
    for name, change in changes.items():
        (tmp_path / f"{name}.json").write_text(json.dumps(window | change), encoding="utf-8")
    hits, left_out = read_hits(tmp_path)
    assert [hit.name for hit in hits] == [good.stem]
    reasons = "skips samples", "skips samples", "neither", "begins", "begins", "ends too early"
    assert len(left_out) == 6 and all(any(reason in text for text in left_out) for reason in reasons)
    assert sum("skips" in text for text in left_out) == 2 and sum("begins" in text for text in left_out) == 2


def test_a_folder_without_hits_says_where_they_are(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no recording") as caught:
        read_hits(tmp_path)
    assert SOURCE.split(",")[0] in str(caught.value)
    write_window(tmp_path, "hit_0", Group(2, 1), rows_of(Group(2, 1), rng("other")))
    with pytest.raises(InputError, match="posture 1, heavy box"):
        list(lines(Request(data=str(tmp_path))))


def test_the_page_and_the_figure_are_written() -> None:
    text = page_of("hits").read_text(encoding="utf-8")
    assert "make study-hits" in text and text.count("| posture 2, heavy box |") >= 10
    assert PICTURE.is_file()
