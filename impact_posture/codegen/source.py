"""Fill the texts of an export with one objective's code."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from impact_posture.codegen import project, templates
from impact_posture.codegen.build_check import self_test_tolerance
from impact_posture.codegen.code import Code
from impact_posture.codegen.emitter import SHORT_NAMES, Real, c_double, c_vector
from impact_posture.codegen.manifest import unit_slices
from impact_posture.codegen.reader import identity
from impact_posture.codegen.variants import Variant
from impact_posture.escape import c_comment, markdown
from impact_posture.impact.objective import ImpactObjective
from impact_posture.version import __version__

# C names among the facts: they stand as they are everywhere.
_NAMES = {"prefix", "upper", "stem", "real"}


def _escaped(facts: dict[str, str], escape: Callable[[str], str]) -> dict[str, str]:
    """The same facts for another language."""
    return {key: value if key in _NAMES else escape(value) for key, value in facts.items()}


def wrapped(words: list[str], indent: str, width: int = 112) -> str:
    """Comma-separated words over several comment lines."""
    lines, line = [], ""
    for k, word in enumerate(words):
        piece = word + ("," if k < len(words) - 1 else "")
        if line and len(line) + len(piece) + 1 > width - len(indent):
            lines.append(line)
            line = ""
        line = f"{line} {piece}" if line else piece
    return f"\n{indent}".join([*lines, line])


def build_texts(
    exported: Sequence[Variant], prefix: str, manifest: dict[str, Any], code: Code, real: Real
) -> dict[str, str]:
    """File name → text of everything but the manifest."""
    joint = next((v for v in exported if v.joint), None)
    exported = [v for v in exported if not v.joint]
    objectives = [v.objective for v in exported if not v.free]
    facts = _facts(objectives, prefix, manifest, real)
    each = [
        facts | _frame_facts(v, alone=len(objectives) == 1 and joint is None, together=joint is not None)
        for v in exported
    ]
    facts = each[0] | facts
    together = _joint_texts(joint, facts, manifest, real)
    comment, prose = _escaped(facts, c_comment), _escaped(facts, markdown)
    comments = [_escaped(block, c_comment) for block in each]
    posture = manifest["posture"]
    declaration = "" if posture is None else templates.POSTURE_DECLARATION.substitute(comment)
    definition = (
        ""
        if posture is None
        else f"\nconst {real.name} {prefix}_posture[{facts['nq']}] = {c_vector(posture, '', real)};\n"
    )
    row = "" if posture is None else f"| `{prefix}_posture` | the impact-robust posture that was found |\n"
    order = {
        "q_order": wrapped([c_comment(v) for v in manifest["q_names"]], " *      "),
        "v_order": wrapped([c_comment(v) for v in manifest["v_names"]], " *      "),
        "convention": comment["convention"].replace("; ", ";\n * "),
        "contacts": "\n".join(templates.CONTACT_LINE.substitute(block) for block in comments if not block["free"]),
        "declarations": "".join(templates.DECLARATIONS.substitute(block) for block in comments) + together["header"],
    }
    tables = {
        key: "\n".join(f"| {k} | {markdown(name)} |" for k, name in enumerate(manifest[names]))
        for key, names in (("q_table", "q_names"), ("v_table", "v_names"))
    }
    blocks = [b for frame in manifest["frames"] for b in (frame, frame["free"]) if b is not None]
    checks = [block | _references(m["self_test"], real) for block, m in zip(comments, blocks, strict=True)]
    return {
        f"{prefix}.h": templates.HEADER.substitute(comment | order, posture=declaration),
        f"{prefix}.c": templates.SOURCE.substitute(
            comment
            | {
                "posture": definition,
                "unit_checks": _unit_checks(objectives[0], real),
                "vectors": code.vectors,
                "functions": code.functions,
                "identity": identity(manifest),
                "undefined": "\n".join(f"#undef {name}" for name in SHORT_NAMES),
            }
        ),
        "example.c": project.EXAMPLE.substitute(
            comment,
            checks="".join(project.EXAMPLE_CHECK.substitute(block) for block in checks) + together["check"],
            calls="".join(f"  worst = fmax(worst, check_{block['stem']}());\n" for block in each) + together["call"],
        ),
        "example.cpp": _eigen(objectives[0], checks[0], manifest["self_test"], real),
        "Makefile": project.MAKEFILE.substitute(comment),
        "CMakeLists.txt": project.CMAKE.substitute(comment),
        "README.md": project.README.substitute(
            prose | tables,
            posture=row,
            c_normal_axes=comment["normal_axes"],
            rows="".join(project.README_ROWS.substitute(_escaped(block, markdown)) for block in each)
            + together["row"],
        ),
    }


def _joint_texts(
    joint: Variant | None, facts: dict[str, str], manifest: dict[str, Any], real: Real
) -> dict[str, str]:
    """What several contacts at once add to each text."""
    if joint is None:
        return dict.fromkeys(("header", "check", "call", "row"), "")
    test, objective = manifest["several"]["self_test"], joint.objective
    box = "|impulse| up to" if objective.bilateral else "impulses from 0 to"
    contacts = [
        f"{c.frame} ({', '.join(f'{v:.9g}' for v in c.normal)}) {c.impulse:g} N s" for c in objective.contacts
    ]
    names = [c_comment(f"({model.name})") for model in objective.model_variants]
    models = wrapped(["The worst of the models", *names], "") if names else ""
    own = _escaped(facts, c_comment) | {
        "stem": joint.stem,
        "box": box,
        "several": wrapped([c_comment(text) for text in contacts], " * "),
        "several_line": markdown(", ".join(contacts)),
        "models": "".join(f"\n * {line}" for line in models.splitlines()),
        "objective_value": c_double(test["objective"]).strip("()"),
        "objective_grad": c_vector(test["objective_grad"]),
        "q": c_vector(test["q"], "  ", real),
    }
    return {
        "header": templates.DECLARATION_SEVERAL.substitute(own),
        "check": project.EXAMPLE_CHECK_SEVERAL.substitute(own),
        "call": f"  worst = fmax(worst, check_{joint.stem}_together());\n",
        "row": project.README_ROW_SEVERAL.substitute(own),
    }


def _facts(
    objectives: Sequence[ImpactObjective], prefix: str, manifest: dict[str, Any], real: Real
) -> dict[str, str]:
    """What all frames share."""
    objective = objectives[0]
    robot, metric = objective.robot, objective.metric
    frames = [o.contact.frame for o in objectives]
    supports = ", ".join(f"{s.frame} ({s.kind})" for s in objective.supports)
    weights = {"euclidean": "W = I", "kinetic": "W = M", "weighted": f"W diagonal, {metric.source or 'given'}"}
    return {
        "title": f"Impact-robustness metric of {robot.name} at {', '.join(frames)}",
        "frames_text": ("frame " if len(frames) == 1 else "frames ") + ", ".join(frames),
        "version": __version__,
        "prefix": prefix,
        "upper": prefix.upper(),
        "real": real.name,
        "stack": str(manifest["stack_bytes"]),
        "tolerance": f"{self_test_tolerance(objective, real):g}",
        "robot": robot.name,
        "sha": robot.model_sha256,
        "metric": f"{metric.kind} ({weights[metric.kind]})",
        "objective": objective.name,
        "units": objective.units,
        "supports": (
            f"{supports}; M stands for M + Js'Js/c with c = {objective.compliance:.6g} 1/kg"
            if supports
            else "none (the free robot)"
        ),
        "convention": robot.convention,
        "unit_rule": (
            f"a quaternion or a cosine-sine pair in q is not of unit norm (to {real.unit_tolerance:g})"
            if unit_slices(robot)
            else "never (this robot's q holds no quaternion and no cosine-sine pair)"
        ),
        "nq": str(manifest["nq"]),
        "nv": str(manifest["nv"]),
    }


def _worst_note(objective: ImpactObjective) -> str:
    """What the objective is the worst of, and what the gradient is where several are as bad."""
    note = ""
    if objective.model_variants:
        note = "; the worst of " + "; ".join(model.name for model in objective.model_variants)
    if objective.normal_cone_deg or objective.model_variants:
        note += "; where several are as bad, grad is a subgradient, that at one of them"
    return note


def _frame_facts(variant: Variant, *, alone: bool, together: bool) -> dict[str, str]:
    objective, stem = variant.objective, variant.stem
    contact = objective.contact
    where = ("" if alone else f" at {contact.frame}") + (", the robot without its supports" if variant.free else "")
    return {
        "stem": stem,
        "free": "free" if variant.free else "",
        "at": where,
        "stem_note": "" if alone else f": {stem}_...",
        "frame": contact.frame,
        "offset": ", ".join(f"{v:.9g}" for v in contact.offset),
        "normal": ", ".join(f"{v:.9g}" for v in contact.normal),
        "cone": (
            f"the worst normal within {objective.normal_cone_deg:g} degrees of"
            if objective.normal_cone_deg
            else "the normal"
        ),
        "own": "The objective of this contact alone" if together else "The exported problem's own objective",
        "cone_note": _worst_note(objective),
        "normal_axes": (
            "world axes" if contact.normal_frame == "world" else f"the axes of contact frame {contact.frame}"
        ),
    }


def _unit_checks(objective: ImpactObjective, real: Real) -> str:
    sums = [" + ".join(f"q[{k}] * q[{k}]" for k in range(s.start, s.stop)) for s in unit_slices(objective.robot)]
    bounds = [real.literal(float(f"{(1 + sign * real.unit_tolerance) ** 2:.12f}")) for sign in (-1, 1)]
    checks = "".join(templates.UNIT_CHECK.substitute(sum=text, low=bounds[0], high=bounds[1]) for text in sums)
    return f"  {real.name} s;\n{checks}" if checks else ""


def _references(test: dict[str, Any], real: Real) -> dict[str, str]:
    """The self-test's numbers: inputs in the export's type and twice, for a batch; references in double."""
    found = {key: c_vector([*test[key], *test[key]], "  ", real) for key in ("q", "n")}
    found |= {key: c_vector(test[key]) for key in ("grad", "objective_grad", "jump", "ellipsoid")}
    return found | {key: c_double(test[key]).strip("()") for key in ("H", "objective", "G", "V")}


def _eigen(objective: ImpactObjective, facts: dict[str, str], test: dict[str, Any], real: Real) -> str:
    world = objective.contact.normal_frame == "world"
    lists = {f"{key}_list": ", ".join(real.literal(v) for v in test[key]) for key in ("q", "n")}
    claim = project.EXAMPLE_CPP_CLAIM.substitute(facts) if world else ""
    return project.EXAMPLE_CPP.substitute(facts | lists, claim=claim)
