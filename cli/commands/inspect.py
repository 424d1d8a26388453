"""``impact-posture inspect ROBOT``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from impact_posture.config.problem_settings import RobotSettings
from impact_posture.config.setting import OUTPUT
from impact_posture_cli import options
from impact_posture_cli.error_boundary import UsageError
from impact_posture_cli.output import Page, number, print_json
from impact_posture_cli.settings_options import TypedSettings, with_settings

if TYPE_CHECKING:
    from impact_posture.config.problem_settings import LoadOptions


WriteRobotToml = Annotated[
    str | None,
    options.option(
        "--write-robot-toml", OUTPUT, "Write a draft of robot.toml to FILE, to the URDF's folder, or to this folder.",
        metavar="[FILE.toml]",
    ),
]  # fmt: skip
ForceFile = Annotated[bool, options.option("--force", OUTPUT, "Replace an existing robot.toml.")]


@with_settings(RobotSettings)
def inspect(
    typed: TypedSettings,
    robot: options.RobotName,
    write_robot_toml: WriteRobotToml = None,
    force: ForceFile = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    from impact_posture.collision.robot_shapes import shape_warnings
    from impact_posture.robot.robot_loader import load_robot
    from impact_posture.robot.robot_summary import summarize

    page, load = Page(json=json, quiet=quiet), typed.fill(RobotSettings, robot=robot)
    if write_robot_toml is not None:
        if load.config is not None:
            raise UsageError("--config contradicts --write-robot-toml, which writes a new robot.toml: leave it out.")
        _write(page, robot, load, write_robot_toml, force=force)
        return
    with page.progress("reading the shapes"):
        loaded = load_robot(robot, load)
        summary = summarize(loaded)
        summary["warnings"] += shape_warnings(loaded)
    if json:
        print_json(summary)
        return
    _head(page, summary)
    _joints(page, summary)
    _frames(page, summary)
    _postures(page, summary)
    if summary["actuation"] is not None:
        _actuation(page, summary["actuation"])
    page.warnings(summary["warnings"])


def _write(page: Page, robot: str, load: LoadOptions, out: str, *, force: bool) -> None:
    from impact_posture.draft.draft import write_draft

    path, draft = write_draft(robot, load, Path(out) if out else None, force=force)
    if page.json:
        print_json({"file": str(path), "guesses": draft.guesses, "text": draft.text})
        return
    page.line(f"written: {path}")
    if not page.quiet:
        page.line("Check what was guessed:")
        page.table((), [("  -", line) for line in dict.fromkeys(draft.guesses)])
        page.line("Then optimize. You need not repeat options that are in this file:")
        beside = path.name == "robot.toml" and path.parent == Path(robot).parent
        config = "" if beside else f" --config {path}"
        # Do not wrap this line, because users copy it.
        page.console.print(f"  impact-posture optimize {robot}{config} --normal X Y Z", soft_wrap=True, markup=False)


def _head(page: Page, summary: dict[str, Any]) -> None:
    contact, supports = summary["contact"], summary["supports"]
    page.title(summary["name"], summary["description"])
    # With a fixed root, the mass excludes links that cannot move.  This text helps users who forgot
    # ``root = "free-flyer"``.
    fixed = ", without links that are fixed to the world" if summary["root"] == "fixed" else ""
    rows = [
        ("model", summary["source"]),
        ("root", f"{summary['root']}; nq {summary['nq']}, nv {summary['nv']}"),
        ("mass", f"{summary['mass']:.4g} kg{fixed}"),
        ("armature from", summary["armature_source"]),
        ("contact frame", _contact(contact)),
    ]
    if contact["frames"]:
        rows.append(("held at contact", ", ".join(f"{k}: {v}" for k, v in contact["frames"].items())))
    rows.append(("supports", ", ".join(f"{s['frame']} ({s['kind']})" for s in supports) or "none"))
    rows.append(("constraints", _constraints(summary["constraints"])))
    if summary["locked"]:
        rows.append(("locked joints", ", ".join(summary["locked"])))
    if summary["couplings"]:
        rows.append(("coupled joints", "; ".join(map(_coupling, summary["couplings"]))))
    page.pairs(rows)


def _coupling(coupling: dict[str, Any]) -> str:
    offset = f" {coupling['offset']:+.4g}" if coupling["offset"] else ""
    return f"{coupling['follower']} = {coupling['ratio']:.4g} {coupling['leader']}{offset}"


def _contact(contact: dict[str, Any]) -> str:
    if contact["frame"] is None:
        return "none by default: give --frame"
    offset = f", offset {contact['offset']} m" if any(contact["offset"]) else ""
    return f"{contact['frame']}{offset}; pose held: {contact['pose']}"


def _constraints(constraints: dict[str, Any]) -> str:
    words = []
    if constraints["level_base"]:
        words.append("level base")
    if constraints["com_over_feet"]:
        words.append(f"center of mass {constraints['com_margin']:g} m inside the feet")
    if constraints["hold"]:
        words.append(f"held joints {', '.join(constraints['hold'])}")
    margin = constraints["limit_margin"]
    words.append(f"joint limits{f' less {margin:g}' if margin else ''}")
    return "; ".join(words)


def _joints(page: Page, summary: dict[str, Any]) -> None:
    def limits(joint: dict[str, Any]) -> str:
        if joint["lower"] is None and joint["upper"] is None:
            return "none"
        if joint["lower"] == joint["upper"] == 0:
            return "not stated"
        return f"{number(joint['lower'], missing='none')} … {number(joint['upper'], missing='none')}"

    page.gap()
    page.title(f"Joints ({len(summary['joints'])})", "SI units: rad, rad/s, N·m, kg·m²; prismatic: m, m/s, N, kg")
    rows = []
    for joint in summary["joints"]:
        numbers = (number(joint[key], missing="not stated") for key in ("velocity", "effort", "armature"))
        rows.append((joint["name"], joint["type"], limits(joint), *numbers))
    page.table(("joint", "type", "limits", "velocity", "effort", "armature"), rows, right=(2, 3, 4, 5), fold=0)


def _frames(page: Page, summary: dict[str, Any]) -> None:
    by_joint: dict[str, list[str]] = {}
    links = [frame for frame in summary["frames"] if frame["link"]]
    for frame in links:
        by_joint.setdefault(frame["joint"], []).append(frame["name"])
    page.gap()
    page.title(f"Link frames ({len(links)})", "listed by the joint that moves them; frames of 'universe' never move")
    page.table(("moved by", "frames"), [(joint, ", ".join(names)) for joint, names in by_joint.items()])
    if not page.quiet:
        page.line("  the frame of a joint has the name of the joint; --json lists every frame", style="dim")


def _postures(page: Page, summary: dict[str, Any]) -> None:
    page.gap()
    page.title(f"Postures ({len(summary['postures'])})")
    rows = []
    for posture in summary["postures"]:
        words = [w for w in ("default" if posture["default"] else "", posture["fault"] or "") if w]
        rows.append((f"  {posture['name']}", "; ".join(words)))
    page.table((), rows)


def _actuation(page: Page, actuation: dict[str, Any]) -> None:
    page.gap()
    condition = number(actuation["condition"], missing="infinite")
    page.title(
        f"Rotors ({actuation['rotors']})",
        f"{number(actuation['thrust_min'])} to {number(actuation['thrust_max'])} N each; "
        f"allocation rank {actuation['rank']} of 6, condition {condition}",
    )
    rows = []
    for at in actuation["postures"]:
        sides = at["lateral_force"] or dict.fromkeys(("forward", "backward", "left", "right"))
        hovers = "yes" if at["feasible"] else "no"
        forces = (number(value, missing="–") for value in sides.values())
        thrusts = f"{min(at['thrusts']):.3g} … {max(at['thrusts']):.3g}"
        rows.append((at["posture"], hovers, thrusts, *forces, "; ".join(at["violations"])))
    head = ("posture", "hovers", "thrusts, N", "forward", "backward", "left", "right", "")
    page.table(head, rows, right=(2, 3, 4, 5, 6))
    page.line("  forward … right: largest net horizontal force at zero tilt, N", style="dim")
