"""Names of robots, links, frames, joints, files and folders are escaped in every output."""

from __future__ import annotations

import io
import json
import re
import subprocess
import tomllib
import unicodedata
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import pytest
import typer
from markdown_it import MarkdownIt
from markdown_it.token import Token
from matplotlib.figure import Figure

from impact_posture import errors
from impact_posture.codegen.c_literals import DOUBLE
from impact_posture.codegen.c_source import build_c_source
from impact_posture.codegen.export import default_prefix, export
from impact_posture.codegen.export_library import named_objectives
from impact_posture.config.problem_settings import LoadOptions, ProblemSettings
from impact_posture.config.table_validation import validate
from impact_posture.draft.draft import write_draft
from impact_posture.dynamics.mjcf import build_mjcf
from impact_posture.experiment.reproduction import Reproduction
from impact_posture.experiment.reproduction_summary import summary
from impact_posture.experiment.seed_statistics import ControllerRow
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.output.plot import ResultView, save
from impact_posture.output.plot.jump_figure import jump_figure
from impact_posture.posture.formulation.problem_file import dump_settings, read_settings
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_loader import load_robot
from impact_posture.robot.robot_spec import RobotSpec, read_spec
from impact_posture.simulation.world.scene import Scene, Shape, Surface
from impact_posture.simulation.world.world_builder import build_scene
from impact_posture.system import escape
from impact_posture_cli.app import app
from impact_posture_cli.argv import put_right
from impact_posture_cli.error_boundary import run
from tests.support.tools import need_compiler

NASTY = (
    "*/ #error out\n#include <nothing.h>", "/* open", "// \\", "a\nb", "a\r\nb", "a\tb", '"', "'", '"; int x; "',
    "\\", "\\n", "%s%n%d", "$\\frac{$", "$", "$$", "${ENV}", "$(touch x)", "]]>", "<script>alert(1)</script>",
    "<!-- --", "&amp;", "[bold]", "[red]red[/red]", "[text](https://example.org)", "a|b", "`code`", "```", "**bold**",
    "_x_", "# head", "\x1b]0;title\x07", "\x1b[31mred", "\x9b31m", "nul\x00byte", "\x7f", "long" * 2500,
    "\u202eleft\u2066", "עברית", "🦾", "é", "../../etc", "/", "int", "while", "??/", "#include", "0lead", "", " ",
    "-rf", ".", "~", "\u2028line", "${prefix}", "$prefix", "{}", "%(name)s", "universe", "world", "a*b?c",
)  # fmt: skip
# A URDF is XML, which cannot contain control characters.
IN_XML = [name for name in NASTY if not re.search("[\x00-\x08\x0b\x0c\x0e-\x1f]", name)]

LINK = '<link name={name}><inertial><origin xyz="0.3 0 0.1"/><mass value="1"/><inertia ixx="0.02" ixy="0" ixz="0" '
LINK += 'iyy="0.03" iyz="0" izz="0.025"/></inertial></link>'
JOINT = '<joint name={name} type="{kind}"><parent link={parent}/><child link={child}/><origin xyz="0.4 0 0"/>'
JOINT += '<axis xyz="0 {y} {z}"/><limit lower="-2" upper="2" effort="9" velocity="3"/></joint>'


def urdf(links: list[str], *, moving: int = 3, name: str = "arm") -> str:
    """Return the URDF of a chain; the name of a joint is the name of its child link followed by j."""
    parts = [LINK.format(name=quoteattr(link)) for link in links]
    for k, (parent, child) in enumerate(pairwise(links)):
        kind = "revolute" if k < moving else "fixed"
        names = {"name": quoteattr(f"{child}j"), "parent": quoteattr(parent), "child": quoteattr(child)}
        parts.append(JOINT.format(**names, kind=kind, y=k % 2, z=1 - k % 2))
    return f"<robot name={quoteattr(name)}>{''.join(parts)}</robot>"


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    path = tmp_path_factory.mktemp("arm") / "arm.urdf"
    path.write_text(urdf(["base", "tip"]))
    return load_robot(str(path))


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Robot:
    """Load a robot whose links, joints and frames have all the strange names that XML allows."""
    folder = tmp_path_factory.mktemp("many")
    (folder / "many.urdf").write_text(urdf(["base", *filter(None, IN_XML)], moving=len(IN_XML)), encoding="utf-8")
    return load_robot(str(folder / "many.urdf"))


def renamed(robot: Robot, name: str) -> Robot:
    """Return the robot with a given name for the robot, its last joint and its tip."""
    model = robot.model.copy()
    model.names[model.njoints - 1] = f"{name}j"
    for frame in model.frames:
        if frame.name == "tip":
            frame.name = name
    return replace(robot, name=name, model=model)


def assert_plain(text: str) -> None:
    """Check that the text contains no control characters and no characters that change the writing direction."""
    bad = {c for c in text if c != "\n" and (unicodedata.category(c)[0] == "C" or c in "\u2028\u2029")}
    assert not bad, ascii(bad)


# ---- the C export -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def exports(arm: Robot, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """Write an export for each strange name and for a harmless name."""
    # The C functions do not depend on names, so they are built only once.
    point = (0.3, 0.0, 0.0)
    harmless = WorstCaseObjective(arm, ImpactContact("tip", (0, 0.6, 0.8), point))
    code = build_c_source(named_objectives([harmless], "arm"), "arm", DOUBLE)
    folders = {}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("impact_posture.codegen.export.build_c_source", lambda *_, **__: code)
        for name in ("tip", *NASTY):
            robot = renamed(arm, name)
            objective = WorstCaseObjective(robot, ImpactContact(name, (0, 0.6, 0.8), point, "contact"))
            folders[name] = tmp_path_factory.mktemp("c")
            export(objective, folders[name], prefix="arm", check=False, posture=robot.posture())
    return folders


def code_of(folder: Path) -> dict[str, str]:
    """Return the files that a compiler or a build tool reads, without comments."""
    files = {}
    for path in sorted(folder.iterdir()):
        if path.suffix not in (".json", ".md"):
            text = path.read_text(encoding="ascii")
            text = re.sub(r"/\*.*?\*/", "", text, flags=re.S) if path.suffix in (".c", ".h") else text
            files[path.name] = re.sub(r"\b[0-9a-f]{64}\b", "HASH", text)
    return files


def test_names_change_nothing_but_comments(exports: dict[str, Path]) -> None:
    expected = code_of(exports["tip"])
    assert set(expected) == {"arm.h", "arm.c", "example.c", "example.cpp", "CMakeLists.txt", "Makefile"}
    for name in NASTY:
        assert code_of(exports[name]) == expected, ascii(name)[:60]


def test_everything_compiles(exports: dict[str, Path]) -> None:
    compiler = need_compiler()
    # Compile all examples with their header, and some of the sources, which differ only in their titles.
    sources = [str(folder / "example.c") for folder in exports.values()]
    sources += [str(exports[name] / "arm.c") for name in NASTY[::6]]
    flags = ["-std=c99", "-trigraphs", "-fsyntax-only", "-Wall", "-Wextra", "-pedantic", "-Werror"]
    done = subprocess.run([*compiler, *flags, *sources], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[:2000]


def test_manifests_have_the_names_without_escapes(exports: dict[str, Path]) -> None:
    for name in NASTY:
        manifest = json.loads((exports[name] / "arm.json").read_text(encoding="ascii"))
        assert (manifest["robot"], manifest["frame"], manifest["joint_names"][-1]) == (name, name, f"{name}j")


def flat(tokens: list[Token]) -> Iterator[Token]:
    for token in tokens:
        yield token
        yield from flat(token.children or [])


def test_readme_shows_names_as_text(exports: dict[str, Path]) -> None:
    parser = MarkdownIt("commonmark", {"html": True}).enable("table")
    shapes: list[str] = []
    for name in ("tip", *NASTY):
        text = (exports[name] / "README.md").read_text(encoding="utf-8")
        assert_plain(text)
        tokens = list(flat(parser.parse(text)))
        assert not [t for t in tokens if t.type.startswith(("html", "link", "image"))], ascii(name)[:60]
        shown = " ".join("".join(t.content for t in tokens if t.type == "text").split())
        assert " ".join(escape.printable(name).split()) in shown, ascii(name)[:60]
        shape = [t.type for t in tokens if t.type.endswith("_open") or t.type == "fence"]
        shapes = shapes or shape
        assert shape == shapes, ascii(name)[:60]


def test_summary_shows_names_as_text() -> None:
    rows = [
        ControllerRow(name, controller, "fell", 1, 0, (name,), {}, None, None, {}, (name,), True, None, None, None)
        for name in ("plain", *NASTY)
        for controller in ("nominal", "robust")
    ]
    text = summary(Reproduction(1, tuple(rows)))
    assert_plain(text)
    tokens = list(flat(MarkdownIt("commonmark", {"html": True}).enable("table").parse(text)))
    assert not [t for t in tokens if t.type.startswith(("html", "link", "image", "fence"))]
    assert sum(t.type == "table_open" for t in tokens) == len(NASTY) + 2
    shown = "".join(t.content for t in tokens if t.type == "text")
    assert all(escape.printable(name).strip() in shown for name in NASTY)


def test_identifiers_and_file_names() -> None:
    for name in NASTY:
        assert re.fullmatch(r"[A-Za-z0-9_]{0,100}", escape.identifier(name))
        file = escape.file_name(name)
        assert file not in ("", ".", "..") and "/" not in file and "\0" not in file and file[0] != "-"
        assert len(file.encode()) <= 120
        assert_plain(file)
    assert escape.identifier("a" * 200) != escape.identifier("a" * 201)


def test_default_prefixes_are_identifiers(arm: Robot) -> None:
    for name in NASTY:
        prefix = default_prefix([WorstCaseObjective(renamed(arm, name), ImpactContact(name, (0, 0, 1)))])
        assert re.fullmatch("[A-Za-z][A-Za-z0-9_]{0,110}", prefix), ascii(name)[:60]


# ---- TOML, MJCF ---------------------------------------------------------------------------------------------------


def test_problem_toml_reads_back(tmp_path: Path) -> None:
    for name in NASTY:
        written = ProblemSettings(
            robot=name, frame=name, posture=name, keep=(name, "b"), hold=(name,), armature={name: 1.0}, lock=(name,)
        )
        text = dump_settings(written)
        assert tomllib.loads(text)["frame"] == name
        assert_plain(text)
    (tmp_path / "problem.toml").write_text(
        dump_settings(ProblemSettings(robot="panda", keep=NASTY)), encoding="utf-8"
    )
    assert read_settings(tmp_path / "problem.toml").keep == NASTY


def test_a_drafted_robot_toml_reads_back(many: Robot, tmp_path: Path) -> None:
    path, _ = write_draft(many.source, LoadOptions(), tmp_path / "draft.toml")
    assert_plain(path.read_text(encoding="utf-8"))
    again = load_robot(many.source, LoadOptions(config=str(path)))
    assert again.joint_names == many.joint_names and again.spec == read_spec(path)


def test_a_path_that_is_not_utf8_is_refused() -> None:
    settings = ProblemSettings(robot="panda", srdf="caf\udce9.srdf")
    with pytest.raises(errors.SpecError, match=r"srdf: 'caf\\udce9.srdf' is not UTF-8"):
        dump_settings(settings)


def test_mujoco_loads_every_name(arm: Robot, many: Robot) -> None:
    pytest.importorskip("mujoco")
    for robot in (many, *[renamed(arm, name) for name in NASTY]):
        written = build_mjcf(robot.model, robot.name)
        model = written.compile()
        assert model.nv == robot.nv
        assert all(model.site(site).id >= 0 for site in written.sites.values())
        assert all(model.body(body).id > 0 for body in written.bodies.values())
        assert len(set(written.sites.values())) == len(written.sites)


def test_mujoco_loads_a_scene_with_these_names(arm: Robot) -> None:
    pytest.importorskip("mujoco")
    for name in NASTY:
        robot = renamed(arm, name)
        surface = Surface(name, (0.0, 0.0, 1.0), gap=0.1)
        built = build_scene(robot, Scene((surface,), (Shape(name, (0.01,)),)), robot.posture())
        model = built.mjcf.compile()
        assert (model.npair, model.ngeom) == (1, 2) and model.geom(built.shape_geoms[0][0]).id >= 0, ascii(name)[:60]


# ---- pictures -----------------------------------------------------------------------------------------------------


def test_a_figure_with_a_long_name(arm: Robot, tmp_path: Path) -> None:
    name = "$\\frac{$\x1b[31m]]>\n--" * 500
    robot = renamed(arm, name)
    objective = WorstCaseObjective(robot, ImpactContact(name, (0, 1, 0), (0.3, 0, 0), "contact"))
    view = ResultView(objective, robot.posture(), robot.posture() + 0.1)
    (path,) = save(jump_figure(view), tmp_path, "jump", ["svg"])
    assert ElementTree.parse(path).getroot().tag.endswith("svg")
    assert_plain(path.read_text(encoding="utf-8"))


def test_labels_are_not_read_as_math(tmp_path: Path) -> None:
    figure = Figure(figsize=(6, 30))
    axes = figure.add_subplot()
    for k, name in enumerate(NASTY):
        axes.plot([0, 1], [k, k], label=escape.plot_label(name) or "(empty)")
    legend = axes.legend(fontsize=4)
    assert len(legend.get_texts()) == len(NASTY)
    (path,) = save(figure, tmp_path, "labels", ["svg"])
    assert ElementTree.parse(path).getroot().tag.endswith("svg")
    assert_plain(path.read_text(encoding="utf-8"))


# ---- the terminal -------------------------------------------------------------------------------------------------


def command(*words: str) -> tuple[int, str, str]:
    out, err = io.StringIO(), io.StringIO()
    with redirect_stdout(out), redirect_stderr(err):
        code = run(typer.main.get_command(app), put_right(list(words)))
    return code, out.getvalue(), err.getvalue()


@pytest.fixture
def shown(many: Robot, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the file of a robot whose name and folder contain terminal control characters."""
    monkeypatch.setenv("COLUMNS", "80")
    folder = tmp_path / "\x1b]0;x\x07[red]\n*"
    folder.mkdir()
    path = folder / "\u202e[bold]\x9b31m$\\frac{$.urdf"
    path.write_bytes(Path(many.source).read_bytes())
    return str(path)


def test_inspect_prints_no_control_characters(shown: str) -> None:
    code, out, err = command("inspect", shown)
    assert code == 0
    assert_plain(out + err)
    assert "[red]red[/red]j" in out and "\\u202e[bold]" in out
    code, out, err = command("inspect", shown, "--json")
    assert code == 0
    assert_plain(out)
    assert {f"{name}j" for name in IN_XML if name} <= {joint["name"] for joint in json.loads(out)["joints"]}


@pytest.mark.parametrize(
    "words",
    [
        ("evaluate", "\x1b[31mnone", "--frame", "x", "--normal", "0", "0", "1"),
        ("evaluate", "panda", "--frame", "\x1b]0;t\x07\u202e\n", "--normal", "0", "0", "1"),
        ("evaluate", "panda", "--posture", "\x9b31m", "--normal", "0", "0", "1"),
        ("evaluate", "panda", "--contact", "\x1b[0m"),
        ("evaluate", "panda", "--lock", "\x1b[0m", "--normal", "0", "0", "1"),
        ("simulate", "\x1b[31m"),
        ("compare", "solo8-push", "--controllers", "nominal,\x1b[31m"),
        ("plot", "\x1b[31m\u2066"),
        ("codegen", "panda", "--normal", "0", "0", "1", "--prefix", "\x1b*/"),
        ("evaluate", "--\x1b[31m"),
        ("\x1b[31m",),
    ],
)
def test_errors_quote_names_safely(words: tuple[str, ...]) -> None:
    code, out, err = command(*words)
    assert code in (1, 2) and not out
    assert_plain(err)
    assert "internal error" not in err
    code, out, err = command(*words, "--json")
    assert_plain(err)
    assert json.loads(out)["error"]["code"] == code


def test_every_error_is_one_safe_line() -> None:
    for name in NASTY:
        error = errors.FrameNotFound(name, NASTY, where=name, hint=name)
        assert_plain(error.line)
        assert "\n" not in error.line and len(error.what) < 1000
        assert_plain(errors.ManifestMismatch(name, name, name, where=name).line)


# ---- files of optimize and codegen ---------------------------------------------------------------------------------


def test_optimize_and_codegen_of_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    compiler = need_compiler()
    monkeypatch.setattr("impact_posture.output.plot.drawable", lambda _: ["jump"])
    names = ["base", '*/ #error "out"\n#include <x>', "$\\frac{$", "[red]|`<script>", "??/\\"]
    folder = tmp_path / "\x1b]0;x\x07 *\n"
    folder.mkdir()
    robot = folder / 'a"b*\n[red].urdf'
    robot.write_text(urdf(names, moving=1), encoding="utf-8")
    problem = [str(robot), "--frame", names[1], "--offset", "0.3", "0", "0", "--normal", "0", "1", "0"]
    out = folder / "out\x1b[31m"
    pose = ["--contact-pose", "free", "--starts", "1", "--jobs", "1", "--format", "svg"]
    code, printed, err = command("optimize", *problem, *pose, "--out", str(out))
    assert code == 0, err
    assert_plain(printed + err)
    assert tomllib.loads((out / "problem.toml").read_text(encoding="utf-8"))["robot"] == str(robot)
    for picture in out.glob("*.svg"):
        ElementTree.parse(picture)
    for words in ((str(out),), tuple(problem)):
        code, printed, err = command("codegen", *words, "--out", str(folder / f"c{len(words)}"))
        assert code == 0, err
        assert_plain(printed + err)
    for written in (out / "c", folder / "c1", folder / f"c{len(problem)}"):
        sources = [str(path) for path in written.glob("*.c")]
        assert len(sources) == 2
        done = subprocess.run([*compiler, "-fsyntax-only", *sources], capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in folder.iterdir()) == sorted([robot.name, out.name, "c1", f"c{len(problem)}"])


def test_a_robot_toml_accepts_every_name() -> None:
    for name in NASTY:
        assert validate(RobotSpec, {"name": name}, "test").name == name
