"""``impact-posture inspect ROBOT``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from impact_posture_cli import options

if TYPE_CHECKING:
    from impact_posture_cli.output import Page


def inspect(
    robot: options.RobotName,
    root: options.Root = None,
    package_dir: options.PackageDirs = None,
    srdf: options.Srdf = None,
    config: options.Config = None,
    armature: options.Armature = None,
    lock: options.Lock = None,
    lock_massless: options.LockMassless = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Show a robot: joints, frames, mass, limits, armature, postures, actuation."""
    from impact_posture.robot.loader import load_robot
    from impact_posture.robot.summary import summarize
    from impact_posture_cli.asked import load_options
    from impact_posture_cli.output import Page, print_json

    load = load_options(
        root=root,
        package_dir=package_dir,
        srdf=srdf,
        config=config,
        armature=armature,
        lock=lock,
        lock_massless=lock_massless,
    )
    summary = summarize(load_robot(robot, load))
    if json:
        print_json(summary)
        return
    page = Page(quiet=quiet)
    _head(page, summary)
    _joints(page, summary)
    _frames(page, summary)
    _postures(page, summary)
    if summary["actuation"] is not None:
        _actuation(page, summary["actuation"])
    page.warnings(summary["warnings"])


def _head(page: Page, summary: dict[str, Any]) -> None:
    contact, supports = summary["contact"], summary["supports"]
    page.title(summary["name"], summary["description"])
    rows = [
        ("model", summary["source"]),
        ("root", f"{summary['root']}; nq {summary['nq']}, nv {summary['nv']}"),
        ("mass", f"{summary['mass']:.4g} kg"),
        ("armature from", summary["armature_source"]),
        ("contact frame", _contact(contact)),
    ]
    if contact["frames"]:
        rows.append(("held at contact", ", ".join(f"{k}: {v}" for k, v in contact["frames"].items())))
    rows.append(("supports", ", ".join(f"{s['frame']} ({s['kind']})" for s in supports) or "none"))
    rows.append(("constraints", _constraints(summary["constraints"])))
    if summary["locked"]:
        rows.append(("locked joints", ", ".join(summary["locked"])))
    page.pairs(rows)


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
    from impact_posture_cli.output import number

    def limits(joint: dict[str, Any]) -> str:
        if joint["lower"] is None and joint["upper"] is None:
            return "none"
        return f"{number(joint['lower'], missing='none')} … {number(joint['upper'], missing='none')}"

    page.gap()
    page.title(f"Joints ({len(summary['joints'])})", "SI units: rad, rad/s, N·m, kg·m²; prismatic: m, m/s, N, kg")
    page.table(
        ("joint", "type", "limits", "velocity", "effort", "armature"),
        [
            (
                j["name"],
                j["type"],
                limits(j),
                number(j["velocity"], missing="none"),
                number(j["effort"], missing="none"),
                number(j["armature"]),
            )
            for j in summary["joints"]
        ],
        right=(2, 3, 4, 5),
        fold=0,
    )


def _frames(page: Page, summary: dict[str, Any]) -> None:
    by_joint: dict[str, list[str]] = {}
    links = [frame for frame in summary["frames"] if frame["link"]]
    for frame in links:
        by_joint.setdefault(frame["joint"], []).append(frame["name"])
    page.gap()
    page.title(f"Link frames ({len(links)})", "by the joint that moves them; those of 'universe' never move")
    page.table(("moved by", "frames"), [(joint, ", ".join(names)) for joint, names in by_joint.items()])
    if not page.quiet:
        page.line("  joints' own frames have the joints' names; --json lists every frame", style="dim")


def _postures(page: Page, summary: dict[str, Any]) -> None:
    page.gap()
    page.title(f"Postures ({len(summary['postures'])})")
    rows = []
    for posture in summary["postures"]:
        words = [w for w in ("default" if posture["default"] else "", posture["fault"] or "") if w]
        rows.append((f"  {posture['name']}", "; ".join(words)))
    page.table((), rows)


def _actuation(page: Page, actuation: dict[str, Any]) -> None:
    from impact_posture_cli.output import number

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
        rows.append(
            (
                at["posture"],
                "yes" if at["feasible"] else "no",
                f"{min(at['thrusts']):.3g} … {max(at['thrusts']):.3g}",
                *(number(value, missing="–") for value in sides.values()),
                "; ".join(at["violations"]),
            )
        )
    page.table(
        ("posture", "hovers", "thrusts, N", "forward", "backward", "left", "right", ""), rows, right=(2, 3, 4, 5, 6)
    )
    page.line("  forward … right: largest net horizontal force at zero tilt, N", style="dim")
