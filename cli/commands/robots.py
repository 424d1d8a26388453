"""``impact-posture robots``."""

from __future__ import annotations

from impact_posture_cli import options
from impact_posture_cli.output import Page, print_json


def robots(json: options.Json = False, quiet: options.Quiet = False) -> None:
    from impact_posture.robot.robot_collections import ways_to_name
    from impact_posture.robot.robot_summary import catalogue

    entries = catalogue()
    if json:
        print_json({"robots": entries, "ways_to_name": list(ways_to_name())})
        return
    page = Page(quiet=quiet)
    page.table(
        ("name", "kind", "contact frame", "description"),
        [(e["name"], e["kind"], e["frame"] or "", e["description"]) for e in entries],
    )
    if not quiet:
        page.gap()
        page.line("ROBOT is one of:")
        page.table((), [("  -", way) for way in ways_to_name()])
        page.line("Known models come from the example-robot-data package, except:")
        bundled = [e["name"] for e in entries if e["from"] != "example-robot-data"]
        page.line(f"  {', '.join(bundled)} (bundled with impact-posture). --json has every source.")
