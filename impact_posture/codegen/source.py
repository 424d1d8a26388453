"""Fill the texts of an export with one objective's code."""

from __future__ import annotations

import re
from typing import Any

import casadi as ca

from impact_posture import __version__
from impact_posture.codegen import templates
from impact_posture.codegen.emitter import c_double, c_vector, emit_function
from impact_posture.codegen.manifest import unit_slices
from impact_posture.impact.objective import ImpactObjective

_PLAIN = str.maketrans({"·": " ", "²": "^2", "×": "x", "λ": "l", "ε": "eps", "⁻": "^-", "¹": "1"})


def plain(text: str) -> str:
    """Text that is safe within a C comment, whatever a joint or frame is called."""
    return re.sub(r"[^A-Za-z0-9 _.,:;+()\[\]=<>^'/|@#%&!-]", "_", text.translate(_PLAIN))


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


def build_texts(objective: ImpactObjective, prefix: str, manifest: dict[str, Any]) -> dict[str, str]:
    """File name → text of everything but the manifest."""
    facts = _facts(objective, prefix, manifest)
    comment = {key: plain(value) for key, value in facts.items()}
    posture = manifest["posture"]
    declaration = "" if posture is None else templates.POSTURE_DECLARATION.substitute(comment)
    definition = (
        "" if posture is None else f"\nconst double {prefix}_posture[{facts['nq']}] = {c_vector(posture, '')};\n"
    )
    row = "" if posture is None else f"| `{prefix}_posture` | the impact-robust posture that was found |\n"
    order = {
        "q_order": wrapped([plain(v) for v in manifest["q_names"]], " *      "),
        "v_order": wrapped([plain(v) for v in manifest["v_names"]], " *      "),
        "convention": comment["convention"].replace("; ", ";\n * "),
    }
    test = manifest["self_test"]
    vectors = {key: c_vector(test[key], "") for key in ("q", "n", "grad", "objective_grad")}
    numbers = {key: c_double(test[key]).strip("()") for key in ("H", "objective")}
    tables = {
        key: "\n".join(f"| {k} | {name} |" for k, name in enumerate(manifest[names]))
        for key, names in (("q_table", "q_names"), ("v_table", "v_names"))
    }
    bodies, call = _code(objective, prefix)
    return {
        f"{prefix}.h": templates.HEADER.substitute(comment | order, posture=declaration),
        f"{prefix}.c": templates.SOURCE.substitute(
            comment | {"posture": definition, "units": _unit_checks(objective), "bodies": bodies, "objective": call}
        ),
        "example.c": templates.EXAMPLE.substitute(facts | vectors | numbers),
        "Makefile": templates.MAKEFILE.substitute(facts),
        "CMakeLists.txt": templates.CMAKE.substitute(facts),
        "README.md": templates.README.substitute(facts | tables, posture=row),
    }


def _facts(objective: ImpactObjective, prefix: str, manifest: dict[str, Any]) -> dict[str, str]:
    robot, contact, metric = objective.robot, objective.contact, objective.metric
    supports = ", ".join(f"{s.frame} ({s.kind})" for s in objective.supports)
    weights = {"euclidean": "W = I", "kinetic": "W = M", "weighted": f"W diagonal, {metric.source or 'given'}"}
    units = unit_slices(robot)
    return {
        "title": f"Impact-robustness metric of {robot.name} at {contact.frame}",
        "version": __version__,
        "prefix": prefix,
        "upper": prefix.upper(),
        "robot": robot.name,
        "sha": robot.model_sha256,
        "frame": contact.frame,
        "offset": ", ".join(f"{v:.9g}" for v in contact.offset),
        "normal": ", ".join(f"{v:.9g}" for v in contact.normal),
        "normal_axes": (
            "world axes" if contact.normal_frame == "world" else f"the axes of contact frame {contact.frame}"
        ),
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
            "a quaternion or a cosine-sine pair in q is not of unit norm (to 1e-6)"
            if units
            else "never (this robot's q holds no quaternion and no cosine-sine pair)"
        ),
        "nq": str(manifest["nq"]),
        "nv": str(manifest["nv"]),
    }


def _unit_checks(objective: ImpactObjective) -> str:
    sums = [" + ".join(f"q[{k}] * q[{k}]" for k in range(s.start, s.stop)) for s in unit_slices(objective.robot)]
    checks = "".join(templates.UNIT_CHECK.substitute(sum=text) for text in sums)
    return f"  double s;\n{checks}" if checks else ""


def _code(objective: ImpactObjective, prefix: str) -> tuple[str, str]:
    """The static functions that hold the numbers' work, and the body of ``<prefix>_objective``."""
    metric = objective.metric_fun()
    q, n = metric.sx_in()
    # The graph of H alone drops what only the gradient needs.
    H = metric.call([q, n])[0]
    bodies = [
        emit_function(f"{prefix}_eval_body", metric),
        emit_function(f"{prefix}_value_body", ca.Function("value", [q, n], [H], ["q", "n"], ["H"], {"cse": True})),
    ]
    normal = c_vector(objective.contact.normal)
    nv = objective.robot.nv
    if objective.name == "impulse":
        scale = c_double(objective.scale)
        call = templates.OBJECTIVE_SCALED.substitute(prefix=prefix, nv=nv, normal=normal, scale=scale)
        return "\n".join(bodies), call
    fixed = objective.gradient_fun().call([q, ca.DM(objective.contact.normal)])
    function = ca.Function("objective", [q], fixed, ["q"], ["value", "grad"], {"cse": True})
    bodies.append(emit_function(f"{prefix}_objective_body", function))
    return "\n".join(bodies), templates.OBJECTIVE_BODY.substitute(prefix=prefix, nv=nv)
