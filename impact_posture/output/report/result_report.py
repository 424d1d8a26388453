"""Report of a posture optimization: content of the page, and the motion from the initial posture to the optimum."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from impact_posture.dynamics.numeric import Numeric
from impact_posture.impact.elasticity.contact_compression import contact_mass
from impact_posture.impact.evaluation.coulomb_jump import coulomb_jump, coulomb_jumps
from impact_posture.impact.evaluation.velocity_jump import normal_jump
from impact_posture.impact.impact_contact import point_on
from impact_posture.output.plot import draw_all
from impact_posture.output.plot.result_view import ALONE, SEPARATOR, ResultView, contact_speeds, header_lines, number
from impact_posture.output.quantity_table import HEAD, QuantityRow, answer_key, quantities, quantity_rows
from impact_posture.output.report.drawn_robot import draw_robot
from impact_posture.output.report.report_page import Content, Table, figures, render_summary, write_page
from impact_posture.output.report.report_scene import Curve, ReportScene, Track, impact_curves
from impact_posture.posture.formulation.problem_file import Prepared
from impact_posture.system.arrays import Array
from impact_posture.system.folder_record import typed_command
from impact_posture.system.scratch_folder import scratch_folder
from impact_posture.system.text_files import read_text

# Maximum number of animation frames of a motion over time.
_MOST = 121


def write_result_report(
    folder: Path,
    prepared: Prepared,
    view: ResultView,
    document: dict[str, Any],
    *,
    meshes: bool = False,
    scene: ReportScene | None = None,
    force: bool | None = None,
) -> Path:
    """Write ``report.html`` of a result, which contains ``problem.toml`` and the figures; return its path.

    ``document`` is the content of ``result.json``.  ``scene`` is an earlier return value of :func:`result_scene`.  If
    ``meshes`` is true, the report may contain the meshes of the user's URDF.  ``force`` is as in :func:`write_page`.

    Raises:
        OutputError: The report cannot be written.
    """
    scene = scene or result_scene(prepared, view, meshes)
    return write_page(folder, _content(folder, prepared, view, document), scene, force)


def result_summary(prepared: Prepared, view: ResultView, document: dict[str, Any]) -> str:
    """Return HTML for notebooks: the picture of the postures, the verdict, and the values before and after."""
    with scratch_folder() as folder:
        draw_all(view, folder, ("png",), ["postures"])
        pictures = figures(folder)
    return render_summary(_verdict(document), [*_before_and_after(prepared, document)], pictures)


def result_scene(prepared: Prepared, view: ResultView, meshes: bool = False) -> ReportScene:
    """Return the 3-D scene of a result.  The surface of a collision constraint may be behind the contact point."""
    around, q = prepared.problem.surroundings, view.q_initial
    if around is not None:
        walls, solids = around.walls_at(q)
        planes = [("ground" if wall.name == "ground" else "surface", wall.point, wall.normal) for wall in walls]
    else:
        numeric, planes, solids = Numeric(view.robot.model).at(q), [], []
        for contact in view.objective.contacts:
            at = numeric.placement(point_on(view.robot, contact.frame, contact.offset))
            turn = at.rotation if contact.normal_frame == "contact" else np.eye(3)
            planes.append(("surface", at.translation, turn @ contact.normal))
    bodies = tuple(hull.vertices @ at.rotation.T + at.translation for hull, at, _ in solids)
    return ReportScene(
        draw_robot(view.robot, meshes), view.objective, (_track(prepared, view),), tuple(planes), bodies, True
    )


def _track(prepared: Prepared, view: ResultView) -> Track:
    times, unit, q, v = _frames(view)
    objective, stiffness = view.objective, prepared.impact.contact_stiffness
    impacts = [[single.oracle.quantities(at) for at in q] for single in objective.singles]
    jumps, impulses = _jumps(view, q)
    curves: list[Curve] = []
    for single, frames, sizes in zip(objective.singles, impacts, impulses.T, strict=True):
        where = f" at {single.contact.frame}" if objective.others else ""
        curves += [*impact_curves(frames, prepared.impact.metric, where), (f"normal impulse{where}", "N·s", sizes)]
        if stiffness is not None:
            masses = [contact_mass(single.oracle, at) for at in q]
            peaks = [np.nan if mass is None else stiffness.peak_force(mass, view.speed) for mass in masses]
            curves.append((f"peak force{where}", "N", np.array(peaks)))
    if v is not None:
        curves.append(("speed of the contact towards the surface", "m/s", contact_speeds(view, q, v)))
        shares = (np.abs(v) / view.robot.velocity_limits).max(axis=1)
        curves.append(("largest share of a velocity limit", "1", shares))
    return Track("", times, unit, q, impacts, jumps, tuple(curves))


def _jumps(view: ResultView, postures: Array) -> tuple[Array, Array]:
    """Return the jump at each posture, shape (n, nv), and the normal impulses, N·s, shape (n, contacts).

    All contacts act at once if their common jump is defined, otherwise only the first contact.  If the impact is
    undefined, the jump is zero and the impulse is NaN.
    """
    objective, rebound, together = view.objective, normal_jump(view.speed, view.restitution), _together(view)
    jumps = np.zeros((len(postures), objective.robot.nv))
    impulses = np.full((len(postures), len(objective.contacts)), np.nan)
    for k, q in enumerate(postures):
        if together:
            several = coulomb_jumps(objective, q, view.speed) or ()
            for i, jump in enumerate(several):
                jumps[k], impulses[k, i] = jump.velocity, jump.normal_impulse
        elif (single := coulomb_jump(objective, q, rebound)) is not None:
            jumps[k], impulses[k, 0] = single.velocity, single.normal_impulse
        elif (impact := objective.oracle.quantities(q)).G > 0:
            jumps[k], impulses[k, 0] = rebound / impact.G * impact.jump, rebound / impact.G
    return jumps, impulses


def _together(view: ResultView) -> bool:
    ends = (view.q_initial, view.q_optimal)
    return bool(view.objective.others) and all(coulomb_jumps(view.objective, q, view.speed) for q in ends)


def _frames(view: ResultView) -> tuple[Array, str, Array, Array | None]:
    """Return the times (or path lengths) of all frames, their unit, and the postures at the frames.

    For a strike, the frames include the contact, and the generalized velocities at the frames are also returned.
    """
    if view.motion is not None and len(view.motion.t) > 1:
        played, strike = view.motion.played, view.motion.strike
        contact = [] if strike is None else [len(view.motion.t) - 1]
        kept = np.unique([*contact, *np.linspace(0, len(played.t) - 1, _MOST).astype(int)])
        return played.t[kept], "s", played.q[kept], None if strike is None else played.v[kept]
    if view.path is not None and view.path.s[-1] > 0:
        # Remove repeated points, because the path lengths of frames must increase.
        kept = np.flatnonzero(np.diff(view.path.s, prepend=-1.0) > 0)
        return view.path.s[kept], "", view.path.q[kept], None
    return np.array([0.0, 1.0]), "", np.array([view.q_initial, view.q_optimal]), None


def _content(folder: Path, prepared: Prepared, view: ResultView, document: dict[str, Any]) -> Content:
    title, small = header_lines(view)
    facts = [fact for fact in small[0].split(SEPARATOR) if not fact.startswith(ALONE)]
    certificate, solver = document["certificate"], document["solver"]
    # Results of earlier versions do not contain this number.
    dominated = solver.get("dominated_starts", 0)
    checks = [
        ("stationarity", certificate["stationarity"], ""),
        ("violation of the constraints", certificate["primal"], ""),
        ("complementarity", certificate["complementarity"], ""),
        ("pose error", certificate["pose_error_m"], "m"),
        ("pose error", certificate["pose_error_rad"], "rad"),
    ]
    active = [f"active: {bound['constraint']}, {bound['side']}" for bound in document["active"]]
    return Content(
        title=title,
        command=typed_command(folder) or "impact-posture optimize problem.toml",
        facts=tuple(facts),
        verdict=_verdict(document),
        tables=(
            *_before_and_after(prepared, document),
            Table(
                f"Certificate, recomputed with {certificate['recomputed_with']}",
                ("", "value", "unit"),
                tuple((name, f"{value:.1e}", unit) for name, value, unit in checks),
            ),
        ),
        moves=_moves(view, document),
        notes=(
            f"{solver['certified_starts']} of {solver['starts']} starts ended at a certified posture."
            + (f" {dominated} were stopped early, because they could not become the best." if dominated else ""),
            # Results of earlier versions do not have this block.
            *([document["search"]["line"]] if "search" in document else []),
            f"At the optimum, the constraints leave {document['redundancy']} degrees of freedom.",
            *document["constraints"], *active, *document["notes"], *document["warnings"],
        ),
        sources=(("problem.toml", read_text(folder / "problem.toml")),),
    )  # fmt: skip


def _verdict(document: dict[str, Any]) -> tuple[str, ...]:
    verdict = document["verdict"]
    # Results of earlier versions do not have the key ``minimized``.
    return verdict["line"], *filter(None, [verdict.get("minimized")]), *verdict["advice"]


def _before_and_after(prepared: Prepared, document: dict[str, Any]) -> Iterator[Table]:
    """Yield a table for the first contact, which includes the objective, and a table for each other contact."""
    blocks = [document[key] for key in ("initial", answer_key(document))]
    contacts = prepared.impact.objective.contacts
    for k, contact in enumerate(contacts):
        if k == 0:
            rows = quantity_rows(prepared.impact, *blocks)
        else:
            before, after = (block["by_contact"][k] for block in blocks)
            named = quantities(prepared.impact.metric)
            rows = [QuantityRow(key, before[key], after[key], unit, meaning) for key, unit, meaning in named]
        alone = f", of an impact at {contact.frame} alone" if len(contacts) > 1 else ""
        alone += "; the objective covers all contacts" if alone and k == 0 else ""
        yield Table(
            f"Before and after{alone}",
            HEAD,
            tuple(row.cells(number) for row in rows),
        )


def _moves(view: ResultView, document: dict[str, Any]) -> str:
    arrows = "The orange arrows show the predicted velocity jump at the stated speed and friction"
    if view.objective.others:
        alone = f"of the impact at {view.objective.contact.frame} alone"
        arrows += f", {'of the plastic impact at all contacts at once' if _together(view) else alone}"
    if view.motion is not None and len(view.motion.t) > 1:
        end = "the optimum" if document["path"]["found"] else "the best posture that was reached"
        if view.motion.strike is not None:
            end += f", the impact at {view.motion.strike.contact_s:.3g} s, and the stop after the impact"
        return f"The slider follows the motion of --path from the initial posture to {end}, over time. {arrows}."
    return (
        "The slider follows the straight line between the two postures, each point pulled onto the constraints. "
        "It is not a motion plan: speed limits and collisions between the points are not checked (--path does that). "
        f"{arrows}."
    )
