"""Generate the files of an export from the templates in ``templates/``.

Names of robots, joints and frames can contain any characters, so a template escapes every inserted text for the
language of its file.  Only text of type :class:`Verbatim` is inserted unchanged.  A template that uses an undefined
name raises an error (``StrictUndefined``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template

from impact_posture.codegen.c_emitter import SHORT_NAMES
from impact_posture.codegen.c_literals import DOUBLE, Real, brace_initializer
from impact_posture.codegen.c_source import CSource
from impact_posture.codegen.export_functions import BLOCK_THREADS, SIGNATURES, lengths
from impact_posture.codegen.export_library import NamedObjective
from impact_posture.codegen.limb_warps import LANES, WARPS
from impact_posture.codegen.manifest_reader import identity
from impact_posture.codegen.self_test import self_test_tolerance
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.robot.robot import Robot, unit_parts
from impact_posture.system.escape import c_comment, markdown
from impact_posture.version import __version__

_WIDTH = 112


class Verbatim(str):
    """Text that a template inserts unchanged, without escaping any character."""

    __slots__ = ()


def render_files(
    exported: Sequence[NamedObjective], prefix: str, manifest: dict[str, Any], code: CSource, real: Real
) -> dict[str, str]:
    """Return file name → text, for every file of the export except the manifest."""
    context = _context(exported, prefix, manifest, code, real)
    templates = load_templates(prefix, cuda=code.cuda is not None)
    return {name: template.render(context) for name, template in templates.items()}


def load_templates(prefix: str = "", *, cuda: bool = False) -> dict[str, Template]:
    """Return file name → template.  The first call is slow, because it compiles the templates."""
    names = {
        f"{prefix}.h": "header.h", f"{prefix}.c": "source.c",
        **{name: name for name in ("example.c", "example.cpp", "Makefile", "CMakeLists.txt", "README.md")},
        **({f"{prefix}.cuh": "cuda.cuh", "example.cu": "example.cu"} if cuda else {}),
    }  # fmt: skip
    package = "impact_posture.codegen"
    languages = {name: environment(package, markdown if name.endswith(".md") else c_comment) for name in names}
    return {name: languages[name].get_template(f"{template}.jinja") for name, template in names.items()}


@cache
def environment(package: str, escape: Callable[[str], str]) -> Environment:
    """Return an environment for the templates of a package; ``escape`` escapes text for the language of the files."""

    def insert(value: object) -> str:
        return value if isinstance(value, Verbatim) else escape(str(value))

    templates = Environment(
        loader=PackageLoader(package),
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        finalize=insert,
    )
    filters: dict[str, Callable[..., str]] = {
        "verbatim": str,
        "c_comment": c_comment,
        "numbers": lambda values: ", ".join(f"{v:.9g}" for v in values),
        "double": DOUBLE.plain,
        "doubles": partial(DOUBLE.initializer, indent="  "),
        "places": lambda values: brace_initializer([str(v) for v in values], 20, "  "),
        "wrapped": lambda words, indent: wrapped(map(escape, words), indent),
        "lines": lambda parts, between: between.join(map(escape, parts)),
    }
    templates.filters |= {name: _verbatim(function) for name, function in filters.items()}
    return templates


def _verbatim(function: Callable[..., str]) -> Callable[..., Verbatim]:
    return lambda *arguments: Verbatim(function(*arguments))


def _couplings(robot: Robot) -> list[dict[str, list[str] | str]]:
    """Return for each leader the equations of its followers in ``q``, and the derivative along the joint motion."""
    q, v, groups = robot.model.idx_qs, robot.model.idx_vs, list[dict[str, list[str] | str]]()
    for leader in dict.fromkeys(c.leader for c in robot.couplings):
        lead, followers = robot.joint_id(leader), [c for c in robot.couplings if c.leader == leader]
        joints = [(c, robot.joint_id(c.follower)) for c in followers]
        group: dict[str, list[str] | str] = {
            "equations": [f"q[{q[k]}] = {c.ratio!r} q[{q[lead]}] + {c.offset!r}" for c, k in joints],
            "derivative": " + ".join([f"grad[{v[lead]}]", *(f"{c.ratio!r} grad[{v[k]}]" for c, k in joints)]),
        }
        groups.append(group)
    return groups


def wrapped(words: Iterable[str], indent: str) -> str:
    """Join words by commas, with line breaks so that the text fits into a comment."""
    lines, line = [], ""
    *first, last = words
    for piece in (*[f"{word}," for word in first], last):
        if line and len(line) + len(piece) + 1 > _WIDTH - len(indent):
            lines.append(line)
            line = ""
        line = f"{line} {piece}" if line else piece
    return f"\n{indent}".join([*lines, line])


def _parameters(real: Real, sizes: Mapping[str, int], function: str) -> str:
    inputs, results = SIGNATURES[function]
    parameters = [f"const {real.name} {name}[{sizes[name]}]" for name in inputs]
    parameters += [
        f"{real.name} {name}[{sizes[name]}]" if name in sizes else f"{real.name} *{name}" for name in results
    ]
    return ", ".join(parameters)


def _context(
    exported: Sequence[NamedObjective], prefix: str, manifest: dict[str, Any], code: CSource, real: Real
) -> dict[str, Any]:
    single = [v for v in exported if not v.joint]
    joint = next((v for v in exported if v.joint), None)
    objectives = [v.objective for v in single if not v.free]
    objective, metric = objectives[0], objectives[0].metric
    names = [o.contact.frame for o in objectives]
    supports = ", ".join(f"{s.frame} ({s.kind})" for s in objective.supports)
    weights = {"euclidean": "W = I", "kinetic": "W = M", "weighted": f"W diagonal, {metric.source or 'given'}"}
    units = [part for _, part in unit_parts(objective.robot.model)]
    tests = [block["self_test"] for f in manifest["frames"] for block in (f, f["free"]) if block is not None]
    alone = len(objectives) == 1 and joint is None
    sizes = lengths(manifest["nq"], manifest["nv"])
    return {
        "manifest": manifest,
        "code": code,
        "version": __version__,
        "prefix": Verbatim(prefix),
        "upper": Verbatim(prefix.upper()),
        "real": real.name,
        "size": real.size,
        "suffix": "" if real.name == "double" else "f",
        "nq": manifest["nq"],
        "nv": manifest["nv"],
        "title": f"Impact-robustness metric of {objective.robot.name} at {', '.join(names)}",
        "frames_text": ("frame " if len(names) == 1 else "frames ") + ", ".join(names),
        "identity": identity(manifest),
        "tolerance": f"{self_test_tolerance(objective, real):g}",
        "metric": f"{metric.kind} ({weights[metric.kind]})",
        "joint_note": f"; {compression['line']}"
        if (compression := manifest["compression"]) and compression["line"]
        else "",
        "supports": (
            f"{supports}; with supports, M means M + Js'Js/c with c = {objective.compliance:.6g} 1/kg"
            if supports
            else "none (the free robot)"
        ),
        "couplings": _couplings(objective.robot),
        "unit_rule": (
            f"a quaternion or a cosine-sine pair in q is not of unit norm (to {real.unit_tolerance:g})"
            if units
            else "never (q of this robot contains no quaternion and no cosine-sine pair)"
        ),
        "units": units,
        "unit_bounds": [real.literal(float(f"{(1 + sign * real.unit_tolerance) ** 2:.12f}")) for sign in (-1, 1)],
        "macros": SHORT_NAMES,
        "block": BLOCK_THREADS,
        "warps": WARPS,
        "lanes": LANES,
        "signatures": SIGNATURES,
        "sizes": sizes,
        "kernels": [
            (Verbatim(v.stem), name) for v in exported for name in (("objective",) if v.joint else SIGNATURES)
        ],
        "parameters": _verbatim(partial(_parameters, real, sizes)),
        "reals": _verbatim(real.initializer),
        "literals": _verbatim(lambda values: ", ".join(map(real.literal, values))),
        "frames": [_frame(v, test, alone) for v, test in zip(single, tests, strict=True)],
        "several": None if joint is None else _several(joint, manifest["several"]["self_test"]),
    }


def _frame(v: NamedObjective, test: dict[str, Any], alone: bool) -> dict[str, Any]:
    objective, stem = v.objective, Verbatim(v.stem)
    contact, cone = objective.contact, objective.normal_cone_deg
    return {
        "stem": stem,
        "free": v.free,
        "test": test,
        "contact": contact,
        "at": ("" if alone else f" at {contact.frame}") + (", the robot without its supports" if v.free else ""),
        "stem_note": "" if alone else f": {stem}_...",
        "cone": f"the worst normal within {cone:g} degrees of" if cone else "the normal",
        "note": _worst_note(objective),
        "axes": "world axes" if contact.normal_frame == "world" else f"the axes of contact frame {contact.frame}",
    }


def _worst_note(objective: WorstCaseObjective) -> str:
    note = ""
    if objective.model_variants:
        note = "; the worst of " + "; ".join(model.name for model in objective.model_variants)
    if objective.normal_cone_deg or objective.model_variants:
        note += ".  If several normals or models have the largest value, grad is the subgradient for one of them"
    if objective.impact_kind.kink:
        note += f", friction {objective.contact.friction:.9g}; {objective.impact_kind.kink}"
    return note


def _several(joint: NamedObjective, test: dict[str, Any]) -> dict[str, Any]:
    objective = joint.objective
    names, bounded = [f"({model.name})" for model in objective.model_variants], objective.impact_kind.adds_up
    box = "|impulse| up to" if objective.bilateral else "impulses from 0 to"
    return {
        "stem": Verbatim(joint.stem),
        "test": test,
        "bounded": bounded,
        "box": box if bounded else "contacts that arrive together and stick:",
        "contacts": [
            f"{c.frame} ({', '.join(f'{v:.9g}' for v in c.normal)})" + f" {c.impulse:g} N s" * bounded
            for c in objective.contacts
        ],
        "models": ["The worst of the models", *names] if names else [],
    }
