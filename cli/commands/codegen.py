"""``impact-posture codegen ROBOT --frame F --normal X Y Z`` or ``impact-posture codegen RESULT_DIR``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import typer

from impact_posture_cli import options

if TYPE_CHECKING:
    from impact_posture.impact.objective import ImpactObjective

# What a result folder leaves to be said.
_FREE = {"robot", "prefix", "out", "float_", "portable", "compile", "force", "json", "quiet"}


def codegen(
    context: typer.Context,
    robot: options.RobotOrResult,
    frame: options.FrameList = None,
    normal: options.Normal = None,
    offset: options.Offset = None,
    normal_frame: options.NormalAxes = "world",
    contact: options.ContactList = None,
    bilateral: options.Bilateral = False,
    impulse: options.Impulse = 1.0,
    metric: options.MetricName = "euclidean",
    weights: options.Weights = None,
    objective: options.ObjectiveName = "impulse",
    normal_cone: options.NormalCone = 0.0,
    armature_range: options.ArmatureRange = None,
    payload: options.PayloadList = None,
    support: options.SupportList = None,
    no_support: options.NoSupport = False,
    lock: options.Lock = None,
    lock_massless: options.LockMassless = False,
    root: options.Root = None,
    armature: options.Armature = None,
    config: options.Config = None,
    srdf: options.Srdf = None,
    package_dir: options.PackageDirs = None,
    prefix: options.Prefix = None,
    out: options.ExportOut = None,
    float_: options.Float = False,
    portable: options.Portable = False,
    compile: options.CompileLibrary = False,
    force: options.Force = False,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Write the metric and its gradient as C code for a controller."""
    from_result = options.is_result(robot)
    if from_result:
        options.refuse_beside_result(context, _FREE)
    else:
        options.check_contact(frame[0] if frame else None, normal, contact)
    supports = options.check_supports(support, no_support)
    from impact_posture.codegen.export import write_export
    from impact_posture_cli.output import Page, print_json
    from impact_posture_cli.progress import progress_bar

    posture = None
    objectives: list[ImpactObjective]
    warnings: tuple[str, ...] = ()
    if from_result:
        from impact_posture.job import load_view

        view = load_view(Path(robot))
        objectives, posture = [view.objective], view.q_optimal
    else:
        from impact_posture.impact.parsing import parse_payload
        from impact_posture.impact.request import ImpactRequest
        from impact_posture_cli.impact_options import load_options

        load = load_options(
            root=root,
            package_dir=package_dir,
            srdf=srdf,
            config=config,
            armature=armature,
            lock=lock,
            lock_massless=lock_massless,
        )
        objectives = []
        frames: list[str | None] = [*frame] if frame else [None]
        for one in frames:
            request = ImpactRequest(
                robot=robot, load=load, frame=one, normal=normal, offset=offset, normal_frame=normal_frame,
                contacts=tuple(contact or ()), bilateral=bilateral, impulse=impulse, supports=supports,
                metric=metric, weights=weights,
                objective=objective, normal_cone=normal_cone, armature_range=armature_range,
                payloads=tuple(parse_payload(text) for text in payload or ()),
            )  # fmt: skip
            impact = request.resolve()
            objectives.append(impact.objective)
            warnings = impact.warnings
    with progress_bar("writing and compiling" if compile else "writing", shown=not (quiet or json)):
        written = write_export(
            objectives,
            Path(out) if out else None,
            prefix=prefix,
            posture=posture,
            single=float_,
            portable=portable,
            build=compile,
            force=force,
        )
    if json:
        print_json(written.to_dict())
        return
    page = Page(quiet=quiet)
    page.warnings(warnings)
    where = ", ".join(contact.frame for o in objectives for contact in o.contacts)
    page.title(f"{objectives[0].robot.name} at {where}", f"objective {objectives[0].name}")
    page.pairs(
        [
            ("folder", str(written.folder)),
            ("functions", ", ".join(written.functions)),
            ("posture", "the result's optimum" if posture is not None else "none"),
            ("numbers", written.manifest["real"]),
            ("stack", f"at most {written.manifest['stack_bytes']} bytes"),
        ]
    )
    page.line(written.verdict)
