"""``report.html``: text, permitted content, and the page in a browser."""

from __future__ import annotations

import base64
import gzip
import hashlib
import json
import re
import shutil
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import impact_posture as ip
from impact_posture.experiment.run_report_content import table_metrics
from impact_posture.experiment.run_reports import thin
from impact_posture.impact.evaluation.coulomb_jump import coulomb_jump, coulomb_jumps
from impact_posture.output.report.drawn_robot import draw_robot
from impact_posture.output.report.report_page import Content, Table, render
from impact_posture.output.report.report_scene import ReportScene
from impact_posture.output.report.result_report import result_scene
from impact_posture.output.result_reader import load_result, rewrite_report
from impact_posture.robot.urdf import parse_urdf
from impact_posture.simulation.series import Series, Window
from tests.support.browser import Tab, browser
from tests.support.command import refused, run, succeed

HOSTILE = "</script><script>document.title='taken'</script><img src=x onerror=\"document.title='taken'\"> \u202e & é"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result folder with two figures."""
    place = tmp_path_factory.mktemp("report") / "out"
    options = ("--normal", 0, 0, 1, "--starts", 1, "--jobs", 1, "--no-codegen", "--out", place)
    done = run("optimize", "tilthex_arm", "--frame", "ee", *options, pictures=("jump", "nullspace"))
    assert (done.returncode, done.stderr) == (0, "")
    return place


@pytest.fixture(scope="module")
def scene(folder: Path) -> ReportScene:
    prepared, view, _ = load_result(folder)
    return result_scene(prepared, view)


class Reader(HTMLParser):
    """Tags of a page with their attributes, and the text of each tag."""

    def __init__(self, page: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.texts: dict[str, list[str]] = {}
        self.packed: dict[str, str] = {}
        self.feed(page)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if self.tags:
            tag, attributes = self.tags[-1]
            self.texts.setdefault(tag, []).append(data)
            if tag == "script":
                self.packed.setdefault(attributes.get("id") or "", data)


def arrays(page: str) -> tuple[dict[str, Any], bytes]:
    """Return the scene of a page, and the buffer with its arrays."""
    texts = [re.search(rf'id="{name}">(.*?)</script>', page, re.S) for name in ("scene", "arrays")]
    first, second = (text[1] for text in texts if text)
    return json.loads(first), gzip.decompress(base64.b64decode(second))


def levels(packed: dict[str, Any], buffer: bytes) -> np.ndarray:
    """Decode like the viewer: cumulative sums modulo 2¹⁶, then scaled levels; shape (rows, columns)."""
    _, offset, count = packed["values"]
    rows = np.frombuffer(buffer, np.uint16, count, offset).reshape(-1, len(packed["low"]))
    return np.cumsum(rows, axis=0, dtype=np.uint16) * np.array(packed["step"]) + np.array(packed["low"])


# ---- the page ------------------------------------------------------------------------------------------------------


def test_the_page_holds_the_result_and_reaches_nothing(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    reader, document = Reader(page), json.loads((folder / "result.json").read_text())
    assert len(page) < 1.3e6
    assert document["verdict"]["line"] in "".join(reader.texts["p"])
    images = sum(tag == "img" for tag, _ in reader.tags)
    assert "jump" in reader.texts["figcaption"] and images == len(list(folder.glob("*.png")))
    # The page shows the command as the user typed it.
    command = reader.texts["code"][0]
    assert command.startswith("impact-posture optimize tilthex_arm --frame ee --normal 0 0 1 --starts 1")
    assert (folder / "problem.toml").read_text().split("\n")[0] in "".join(reader.texts["pre"])
    # All addresses refer to content of the page itself.
    for _, attributes in reader.tags:
        for name in ("src", "href", "srcset", "data", "action"):
            assert (attributes.get(name) or "data:").startswith("data:")
    (policy,) = [a["content"] or "" for t, a in reader.tags if t == "meta" and "http-equiv" in a]
    assert policy.startswith("default-src 'none';") and "unsafe" not in policy and "http" not in policy
    loader, style = (page.rpartition(f"<{tag}>")[2].partition(f"</{tag}>")[0] for tag in ("script", "style"))
    # The policy permits only the loader script and the viewer that it unpacks.
    viewer = gzip.decompress(base64.b64decode(reader.packed["viewer"])).decode()
    hashes = [
        f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
        for text in (loader, viewer, style)
    ]
    assert f"script-src {hashes[0]} {hashes[1]};" in policy and f"style-src {hashes[2]}" in policy
    assert "three.js authors" in viewer and "MIT License" in page


def test_commands(folder: Path, tmp_path: Path) -> None:
    again = tmp_path / "again"
    shutil.copytree(folder, again)
    (again / "report.html").unlink()
    refused(run("view", again), 1, "report.html: is not there", "impact-posture report")
    done = run("report", again, "--json")
    assert json.loads(done.stdout) == {"schema": "impact-posture/report/1", "file": str(again / "report.html")}
    assert (again / "report.html").read_bytes() == (folder / "report.html").read_bytes()
    assert "report.html" in json.loads((again / ".impact-posture.json").read_text())["files"]
    opened = tmp_path / "opened"
    (tmp_path / "browse").write_text(f"#!/bin/sh\nprintf '%s' \"$1\" > '{opened}'\n")
    (tmp_path / "browse").chmod(0o755)
    succeed("view", again, env={"BROWSER": str(tmp_path / "browse")})
    assert opened.read_text() == (again / "report.html").as_uri()
    refused(run("view", again, env={"BROWSER": "false"}), 1, "no browser could be started")
    refused(run("report", tmp_path), 1, "holds no result.json")


def test_a_result_is_kept_without_its_report(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("no\nroom")

    robot = ip.load_robot("tilthex_arm")
    result = ip.optimize(
        ip.PostureProblem(ip.ImpactObjective(robot, ip.ImpactContact("ee", (0, 0, 1)))), starts=1, jobs=1
    )
    monkeypatch.setattr("impact_posture.output.plot.drawable", lambda *_: [])
    with monkeypatch.context() as patch:
        patch.setattr("impact_posture.output.report.result_report.write_page", fail)
        written = result.save(tmp_path / "out", codegen=False, jobs=1)
    assert written.report_error == "RuntimeError: no room"
    assert (tmp_path / "out" / "posture.json").is_file() and not (tmp_path / "out" / "report.html").exists()
    assert not result.save(tmp_path / "bare", codegen=False, report=False, jobs=1).report_error
    # A result made in Python gets a page with the command that recreates the result.
    assert not rewrite_report(tmp_path / "bare").name.startswith(".")
    page = (tmp_path / "bare" / "report.html").read_text()
    assert Reader(page).texts["code"][0] == "impact-posture optimize problem.toml"


def test_parameters_are_plain_on_the_page(scene: ReportScene) -> None:
    content = Content("", "", (), ("`objective` coulomb minimizes this jump", "`max_force`"), (), "", ("`meshes`",))
    texts = Reader(render(content, Packed(**vars(scene)), ())).texts
    assert "objective coulomb minimizes this jump" in texts["p"] and "max_force" in texts["p"]
    assert "meshes" in texts["li"]


def test_every_contact_is_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("impact_posture.output.plot.drawable", lambda *_: [])
    robot = ip.load_robot("solo12")
    contacts = [ip.ImpactContact(foot, (0, 0, 1)) for foot in ("FL_FOOT", "HR_FOOT")]
    feet = tuple(ip.Support(foot) for foot in ("FR_FOOT", "HL_FOOT"))
    objective = ip.ImpactObjective(robot, contacts[0], others=(contacts[1],), supports=feet)
    problem = ip.PostureProblem(objective, contact_pose="position", collision=False)
    result = ip.optimize(problem, starts=1, jobs=1, compile="never")
    result.save(tmp_path / "out", codegen=False, report=False, jobs=1)
    # In the recorded run, the velocity jump of the impact takes 15 ms.
    monkeypatch.setattr(
        "impact_posture.output.report.result_report._frames", lambda view: (np.arange(2.0), "", view.path.q[:2], None)
    )
    prepared, view, _ = load_result(tmp_path / "out")
    scene = result_scene(prepared, view)
    packed, arrays = json.loads(scene.packed[0]), gzip.decompress(base64.b64decode(scene.packed[1]))
    model, data, (track,) = robot.model, robot.model.createData(), packed["tracks"]
    q = scene.tracks[0].q[-1]
    pin.framesForwardKinematics(model, data, q)
    at = levels(track["points"], arrays)[-1].reshape(2, 3)
    assert np.allclose(at, [data.oMf[robot.frame_id(one.frame)].translation for one in contacts], atol=1e-4)
    # The square of each ellipsoid is Λ_c of its contact; the arrow is the jump of both impacts together.
    for packed_root, single in zip(
        levels(track["ellipsoids"], arrays)[-1].reshape(2, 6), view.objective.singles, strict=True
    ):
        root = np.zeros((3, 3))
        root[np.triu_indices(3)] = root.T[np.triu_indices(3)] = packed_root
        expected = single.oracle.quantities(q).ellipsoid
        assert np.allclose(root @ root, expected, atol=1e-2 * np.abs(expected).max())
    both = coulomb_jumps(view.objective, q, view.speed)
    assert both is not None and np.allclose(scene.tracks[0].jumps[-1], both[0].velocity)
    assert [foot["joint"] for foot in packed["feet"]] == [
        model.frames[robot.frame_id(foot.frame)].parentJoint for foot in feet
    ]
    page = rewrite_report(tmp_path / "out").read_text()
    captions = Reader(page).texts["caption"]
    first = "Before and after, of an impact at FL_FOOT alone; the objective covers all contacts"
    assert {first, "Before and after, of an impact at HR_FOOT alone"} <= {*captions}
    assert "H at FL_FOOT" in page and "impulse at HR_FOOT" in page and "contacts at once" in page


def written(text: str, scene: ReportScene) -> str:
    table = Table(text, ("", text), ((text, text),))
    return render(
        Content(text, text, (text,), (text,), (table,), text, (text,), ((text, text),)), scene, [(text, "data:,")]
    )


class Packed(ReportScene):
    packed = ("{}", "")  # type: ignore[assignment]


@settings(max_examples=12, deadline=None)
@given(st.text(min_size=1, max_size=40) | st.sampled_from([HOSTILE, "'\"><b>", "{{ 7 * 7 }}", "]]><!--", "\ud800"]))
def test_texts_stay_texts(scene: ReportScene, text: str) -> None:
    light = Packed(**vars(scene))
    page = written(text, light)
    hostile, plain = Reader(page), Reader(written("x", light))
    # The page has the same tags and attributes as with a harmless text, and the same writing direction.
    assert [(tag, list(attributes)) for tag, attributes in hostile.tags] == [(t, list(a)) for t, a in plain.tags]
    assert "\u202e" not in page


# ---- measured motion -----------------------------------------------------------------------------------------------


def test_the_viewer_gets_the_robot_where_it_is(folder: Path) -> None:
    page = (folder / "report.html").read_text()
    packed, buffer = arrays(page)
    _, view, _ = load_result(folder)
    (track,), model = packed["tracks"], view.robot.model
    poses = levels(track["poses"], buffer).reshape(-1, model.njoints - 1, 7)
    jumps = levels(track["jumps"], buffer).reshape(len(poses), model.njoints, 3)
    assert view.path is not None and len(poses) == len(view.path.q)
    data = model.createData()
    for k in (0, 30, 60):
        pin.forwardKinematics(model, data, view.path.q[k])
        placed = [pin.SE3.Identity()]
        for j in range(1, model.njoints):
            quaternion = poses[k, j - 1, 3:] / np.linalg.norm(poses[k, j - 1, 3:])
            placed.append(
                placed[packed["joints"][j]["parent"]] * pin.XYZQUATToSE3(np.r_[poses[k, j - 1, :3], quaternion])
            )
            assert np.allclose(placed[j].homogeneous, data.oMi[j].homogeneous, atol=2e-4)
            tip = data.oMi[j].act(model.inertias[j].lever) + packed["scale"]["jump"] * jumps[k, j]
            assert np.linalg.norm(tip - packed["center"]) < packed["radius"] + 1e-3
    # The arrow of a link is the velocity of its center of mass, computed by a finite difference along the jump.
    jump, centers = coulomb_jump(view.objective, view.q_optimal, 1.0), []
    assert jump is not None
    for sign in (-1, 1):
        pin.forwardKinematics(model, data, pin.integrate(model, view.q_optimal, sign * 1e-6 * jump.velocity))
        centers.append([data.oMi[j].act(model.inertias[j].lever) for j in range(1, model.njoints)])
    assert np.allclose(jumps[-1, 1:], (np.array(centers[1]) - centers[0]) / 2e-6, atol=1e-3)


def test_metrics_of_a_push_are_explained_as_those_of_a_push() -> None:
    views = {pushed: SimpleNamespace(pushed=pushed) for pushed in (True, False)}
    words = {pushed: {key: word for key, _, word in table_metrics(view)} for pushed, view in views.items()}  # type: ignore[arg-type]
    assert "15 ms of the touch" in words[False]["peak_jump"] and "push" in words[True]["peak_jump"]
    assert list(words[True]) == list(words[False])


def test_a_run_is_thinned_where_nothing_happens() -> None:
    generator, n = np.random.default_rng(3), 4000
    columns = {name: np.zeros((n, 1)) for name in Series.__dataclass_fields__}
    columns |= {"t": 0.001 * np.arange(1, n + 1), "force": generator.normal(size=(n, 3)), "peak": generator.random(n)}
    columns["q"] = np.where(np.arange(n)[:, None] < 3500, 0.0, np.nan)
    thinned = thin(Series(**columns), [Window("impact", 0, 1.0, 1.3, True), Window("recovery", 0, 1.0, 2.0, True)])
    inside = (thinned.t >= 1.0) & (thinned.t <= 1.3)
    assert np.allclose(np.diff(thinned.t[inside]), 0.001) and inside.sum() >= 300
    assert np.diff(thinned.t).max() <= 0.0251 and len(thinned.t) < 450 and thinned.t[-1] == columns["t"][3499]
    # After thinning, the frames still contain the largest force peak.
    assert thinned.peak.max() == columns["peak"][:3500].max()
    sizes = np.linalg.norm(columns["force"][:3500], axis=1)
    assert np.linalg.norm(thinned.force, axis=1).max() == sizes.max()


# ---- shapes --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "largest", "license"),
    [("talos", 1.2e6, "Apache-2.0"), ("icub", 0.5e6, "CC-BY-SA-4.0"), ("ur5", 0.9e6, "BSD")],
)
def test_known_robots_come_with_meshes_and_their_license(name: str, largest: float, license: str) -> None:
    robot = ip.load_robot(name)
    drawn = draw_robot(robot)
    assert [one.license for one in drawn.licenses] == [license] and drawn.licenses[0].upstream.startswith("https://")
    size = sum(4 / 3 * (solid.corners.nbytes + 2 * solid.faces.size) for solid in drawn.solids)
    # The page contains compressed meshes, and compression reduces every mesh by at least half.
    assert 0.5 * size < largest and sum(len(solid.faces) for solid in drawn.solids) <= 150_000
    assert robot.files is not None
    links = parse_urdf(robot.files.urdf).findall("link")
    assert len(drawn.parts) >= sum(len(link.findall("visual")) for link in links)
    for solid in drawn.solids:
        assert solid.faces.max() == len(solid.corners) - 1 and len(np.unique(solid.faces)) == len(solid.corners)


TETRAHEDRON = np.array([[0.1, 0, 0], [0, 0.2, 0], [0, 0, 0.3], [0.02, 0.02, 0.02]])
URDF = """<robot name="own"><link name="a">{inertial}{a}</link><link name="b">{inertial}{b}</link>
<joint name="j" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0 0 0.5"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" effort="1" velocity="1"/></joint></robot>"""
INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'


def user_robot(folder: Path, a: str, b: str) -> ip.Robot:
    # The second last point lies in a dent, so the hull has one corner less.
    corners = [f"v {x} {y} {z}" for x, y, z in [*TETRAHEDRON, [0, 0, 0]]]
    faces = ["f 1 2 4", "f 2 3 4", "f 3 1 4", "f 1 5 2", "f 2 5 3", "f 3 5 1"]
    (folder / "dent.obj").write_text("\n".join([*corners, *faces]))
    (folder / "own.urdf").write_text(URDF.format(inertial=INERTIAL, a=a, b=b))
    return ip.load_robot(str(folder / "own.urdf"))


def visual(shape: str) -> str:
    return f'<visual><geometry>{shape}</geometry><material name=""><color rgba="0.5 0.6 0.7 1"/></material></visual>'


def test_own_meshes_go_in_only_if_asked(tmp_path: Path) -> None:
    robot = user_robot(
        tmp_path, visual('<mesh filename="dent.obj"/>'), visual('<mesh filename="dent.obj" scale="2 2 2"/>')
    )
    hulls, meshes = draw_robot(robot), draw_robot(robot, True)
    assert [len(one.solids[0].corners) for one in (hulls, meshes)] == [4, 5] and hulls.licenses == ()
    assert "hulls" in hulls.notes[0] and not meshes.notes
    # A mesh file that is used with two scales gives two meshes.
    extents = [np.ptp(solid.points, axis=0) for solid in meshes.solids]
    assert np.allclose(extents, [[0.1, 0.2, 0.3], [0.2, 0.4, 0.6]], atol=1e-5)
    assert meshes.parts[0][3] == (0.5, 0.6, 0.7, 1.0)


def test_small_shapes_beside_large_meshes_are_drawn() -> None:
    """The base of this robot is a box of 1 mm, smaller than the distance within which mesh points are merged."""
    robot = ip.load_robot("example-robot-data:b1_description/urdf/b1-z1.urdf")
    solids = draw_robot(robot).solids
    assert all(len(solid.faces) for solid in solids)
    box = min(solids, key=lambda solid: float(np.ptp(solid.points, axis=0).max()))
    np.testing.assert_allclose(np.ptp(box.points, axis=0), 0.001, rtol=1e-4)
    a, b, c = (box.points[box.faces[:, k]] for k in range(3))
    assert np.all(np.sum(np.cross(b - a, c - a) * (a - box.points.mean(axis=0)), axis=1) > 0)


def test_primitives_and_robots_without_shapes(tmp_path: Path) -> None:
    drawn = draw_robot(user_robot(tmp_path, visual('<box size="0.1 0.2 0.3"/>'), visual('<sphere radius="0.1"/>')))
    assert np.allclose(np.ptp(drawn.solids[0].points, axis=0), [0.1, 0.2, 0.3], atol=1e-5) and not drawn.notes
    (tmp_path / "bare").mkdir()
    sticks = draw_robot(user_robot(tmp_path / "bare", "", visual('<mesh filename="missing.obj"/>')))
    assert len(sticks.parts) == 1 and "sticks" in sticks.notes[-1] and "missing.obj" in sticks.notes[0]
    assert np.ptp(sticks.solids[0].points[:, 2]) >= 0.5
    # The last stick ends at the farthest frame of the last link, because contacts may be there.
    tool = """<link name="tool"/><joint name="flange" type="fixed"><origin xyz="0.3 0 0"/><parent link="b"/>
    <child link="tool"/></joint></robot>"""
    (tmp_path / "tool.urdf").write_text(URDF.format(inertial=INERTIAL, a="", b="").replace("</robot>", tool))
    sticks = draw_robot(ip.load_robot(str(tmp_path / "tool.urdf")))
    assert [joint for joint, *_ in sticks.parts] == [0, 1]
    assert 0.3 < np.ptp(sticks.solids[1].points[:, 0]) < 0.34


# ---- page in a browser ---------------------------------------------------------------------------------------------


def different(a: np.ndarray, b: np.ndarray) -> float:
    """Return the fraction of the pixels that differ."""
    return float((np.abs(a - b).sum(axis=2) > 40).mean())


def near(picture: np.ndarray, color: tuple[int, int, int], within: int = 40) -> float:
    """Return the fraction of the pixels near a color."""
    return float((np.abs(picture - np.array(color)).sum(axis=2) < within).mean())


def hide(tab: Tab, name: str) -> None:
    tab.evaluate(f"document.querySelector('#layers [name={name}]').click()")


def test_a_browser_draws_it_offline(folder: Path, scene: ReportScene, tmp_path: Path) -> None:
    hostile = tmp_path / "hostile.html"
    hostile.write_text(written(HOSTILE, scene), encoding="utf-8")
    with browser(tmp_path / "profile") as tab:
        tab.open(folder / "report.html")
        before = tab.picture("#view")
        # Hiding the surface or the robot changes the picture, so both were visible.
        hide(tab, "surface")
        without_surface = tab.picture("#view")
        assert different(before, without_surface) > 0.05
        for name in ("robot", "jumps"):
            hide(tab, name)
        assert different(without_surface, tab.picture("#view")) > 0.03
        for name in ("robot", "jumps", "surface"):
            hide(tab, name)
        assert different(before, tab.picture("#view")) == 0
        # The slider moves the robot and shows its position; the initial posture stays visible as a ghost.
        tab.evaluate("document.getElementById('end').click()")
        after = tab.picture("#view")
        assert different(before, after) > 0.03
        hide(tab, "ghost")
        assert different(after, tab.picture("#view")) > 0.01
        document = json.loads((folder / "result.json").read_text())
        shown = tab.evaluate(
            "[document.getElementById('where').textContent, document.querySelector('figure output').textContent]"
        )
        assert shown[0] == "100 % of the way" and float(shown[1]) == pytest.approx(document["optimal"]["H"], rel=1e-3)
        # On a phone, nothing is wider than the screen.
        tab.resize(360, 640)
        assert tab.evaluate("document.documentElement.scrollWidth") <= 360
        assert not tab.complaints()
        # Text that looks like a script is not executed.
        tab.open(hostile)
        assert tab.evaluate("document.title") != "taken" and not tab.complaints()
        # Without WebGL, the page still shows text, curves and figures.
        none = "HTMLCanvasElement.prototype.getContext = () => null"
        number = tab.send("Page.addScriptToEvaluateOnNewDocument", source=none)["identifier"]
        tab.open(folder / "report.html", "words")
        figure = "document.querySelector('[alt=\"Figure jump\"]').naturalWidth > 300"
        assert tab.evaluate(f"!nogl.hidden && view.hidden && {figure}")
        tab.send("Page.removeScriptToEvaluateOnNewDocument", identifier=number)
        # Without scripts, too.
        tab.send("Emulation.setScriptExecutionDisabled", value=True)
        tab.open(folder / "report.html", None)
        assert tab.evaluate(f"controls.hidden && document.querySelector('noscript p') !== null && {figure}")
