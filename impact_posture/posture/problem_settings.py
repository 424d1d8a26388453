"""``problem.toml``: an optimization as a file.  Every key is the option of the same name, ``-`` written ``_``."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from impact_posture.errors import InputError, SpecError
from impact_posture.escape import toml
from impact_posture.impact.metric import Metric, MetricKind, ObjectiveKind
from impact_posture.impact.request import FLOATS, ImpactRequest, ResolvedImpact
from impact_posture.posture.build_problem import build_problem
from impact_posture.posture.constraint import CenterOfMassOverFeet
from impact_posture.posture.problem import BaseMode, PostureProblem, Requirements
from impact_posture.robot.model_variant import Payload
from impact_posture.robot.robot_loader import LoadOptions, from_folder, names_a_path
from impact_posture.robot.spec import ContactPose, Root, Vector3, read_toml, validate, with_tuples
from impact_posture.robot.urdf import EXAMPLE_PREFIX

SCHEMA = "impact-posture/problem/1"

_FILES = ("srdf", "config")


class ProblemSettings(BaseModel):
    """The content of a ``problem.toml``; what is ``None`` comes from the robot or is the option's default."""

    # Strict: a number in quotes or a true for 1 is a slip, not a value.
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)

    schema_: Literal["impact-posture/problem/1"] = Field(default="impact-posture/problem/1", alias="schema")
    robot: str
    root: Root | None = None
    package_dir: tuple[str, ...] = ()
    srdf: str | None = None
    config: str | None = None
    armature: str | dict[str, float] | None = None
    lock: tuple[str, ...] = ()
    lock_massless: bool = False
    frame: str | None = None
    normal: Vector3 | None = None
    normal_frame: Literal["world", "contact"] = "world"
    offset: Vector3 | None = None
    contact: str | tuple[str, ...] | None = None
    bilateral: bool = False
    impulse: float = 1.0
    speed: float = 1.0
    restitution: float = 0.0
    posture: str | None = None
    q: tuple[float, ...] | None = None
    target_position: Vector3 | None = None
    target_quaternion: tuple[float, float, float, float] | None = None
    contact_pose: ContactPose | None = None
    box: Vector3 = (0.05, 0.05, 0.05)
    support: tuple[str, ...] | None = None
    support_compliance: float | None = None
    keep: tuple[str, ...] = ()
    hold: tuple[str, ...] | None = None
    base: BaseMode | None = None
    base_box: Vector3 = (0.2, 0.2, 0.2)
    com: bool | None = None
    com_margin: float | None = None
    keep_contacts: bool = False
    friction: float = 0.7
    limit_margin: float | None = None
    regularization: float = 0.0
    metric: MetricKind = "euclidean"
    weights: str | tuple[float, ...] | None = None
    objective: ObjectiveKind = "impulse"
    normal_cone: float = 0.0
    armature_range: tuple[float, float] | None = None
    payload: tuple[tuple[str, float], ...] = ()
    tradeoff: Annotated[int, Field(ge=0)] = 0
    starts: Annotated[int, Field(ge=1)] = 16
    seed: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True)
class Prepared:
    """A problem ready to be solved.

    Attributes:
        settings: As merged from file and command line.
        impact: Robot, contact, metric, supports, given posture.
        problem: The optimization.
    """

    settings: ProblemSettings
    impact: ResolvedImpact
    problem: PostureProblem


def read_settings(path: Path, over: dict[str, object] | None = None) -> ProblemSettings:
    """Read a ``problem.toml``; ``over`` (options of the command line) wins.  Paths in it start from its folder."""
    data = from_folder(read_toml(path), path.resolve().parent, (*_FILES, "weights", "armature", "posture"))
    over = over or {}
    # What the command line says replaces what the file says of the same thing in other words.
    if over.get("metric", "weighted") != "weighted" and "weights" not in over:
        data.pop("weights", None)
    if "frame" in over or "normal" in over:
        data.pop("contact", None)
    if "contact" in over:
        data.pop("frame", None)
        data.pop("normal", None)
    if "posture" in over:
        data.pop("q", None)
    return validate(ProblemSettings, with_tuples(data | over), str(path))


def make_settings(values: dict[str, object]) -> ProblemSettings:
    """Check values that came as options."""
    return validate(ProblemSettings, values, "options")


def prepare(settings: ProblemSettings) -> Prepared:
    """Load the robot, resolve defaults, build the problem; nothing is solved yet.

    Raises:
        ImpactPostureError: The first thing that is wrong, in one line.
    """
    contacts = (settings.contact,) if isinstance(settings.contact, str) else settings.contact or ()
    if isinstance(settings.weights, tuple) and settings.metric != "weighted":
        raise InputError(
            f"weights are listed, but the metric is {settings.metric}",
            where="weights",
            hint='remove them or say "weighted"',
        )
    weights = settings.weights if isinstance(settings.weights, str) else None
    request = ImpactRequest(
        robot=settings.robot,
        load=LoadOptions(
            root=settings.root,
            package_dirs=settings.package_dir,
            srdf=settings.srdf,
            config=settings.config,
            armature=settings.armature,
            lock=settings.lock,
            lock_massless=settings.lock_massless,
        ),
        frame=settings.frame,
        normal=settings.normal,
        offset=settings.offset,
        normal_frame=settings.normal_frame,
        contacts=contacts,
        bilateral=settings.bilateral,
        impulse=settings.impulse,
        posture=settings.posture if settings.q is None else None,
        supports=settings.support,
        metric="euclidean" if isinstance(settings.weights, tuple) else settings.metric,
        weights=weights,
        objective=settings.objective,
        speed=settings.speed,
        restitution=settings.restitution,
        compliance=settings.support_compliance,
        normal_cone=settings.normal_cone,
        armature_range=settings.armature_range,
        payloads=tuple(Payload(frame, mass) for frame, mass in settings.payload),
    )
    impact = request.resolve()
    if isinstance(settings.weights, tuple):
        impact = replace(impact, objective=replace(impact.objective, metric=_listed_metric(settings, impact)))
    if settings.q is not None:
        impact = replace(impact, q=impact.robot.check_posture(np.array(settings.q), where="q"))
    if impact.missing_support:
        if settings.base is None:
            what = f"nothing says what holds {impact.robot.name} up, {FLOATS}"
            raise InputError(what, where=settings.robot, hint=impact.missing_support)
        impact = replace(impact, missing_support="")
    problem = build_problem(impact.robot, impact.objective, impact.q, _requirements(settings, impact))
    return Prepared(settings, impact, problem)


def _listed_metric(settings: ProblemSettings, impact: ResolvedImpact) -> Metric:
    weights = np.array(settings.weights, dtype=float)
    if weights.size != impact.robot.nv or not (np.isfinite(weights).all() and (weights > 0).all()):
        raise SpecError(
            f"has {weights.size} entries", where="weights", hint=f"give {impact.robot.nv} numbers above zero"
        )
    return Metric("weighted", tuple(float(w) for w in weights), "problem.toml")


def _requirements(settings: ProblemSettings, impact: ResolvedImpact) -> Requirements:
    robot, spec = impact.robot, impact.robot.spec.constraints
    free = tuple(j for j in spec.hold if j not in robot.locked)
    base: BaseMode = "level" if spec.level_base and robot.floating else "free"
    com = spec.com_over_feet and bool(impact.supports) if settings.com is None else settings.com
    if com and not impact.supports:
        raise InputError(
            "there are no feet to keep the center of mass over", where="--com", hint="add --support or --no-com"
        )
    if settings.keep_contacts and not impact.supports:
        raise InputError("there are no feet to keep", where="--keep-contacts", hint="add --support or leave it out")
    return Requirements(
        contact_pose=settings.contact_pose or robot.contact_pose(impact.contact.frame),
        other_poses=tuple(settings.contact_pose or robot.contact_pose(c.frame) for c in impact.objective.others),
        target_position=settings.target_position,
        target_quaternion=settings.target_quaternion,
        box=settings.box,
        base=settings.base or base,
        base_box=settings.base_box,
        keep=settings.keep,
        hold=free if settings.hold is None else settings.hold,
        com_over_feet=com,
        com_asked=settings.com is not None,
        com_margin=spec.com_margin if settings.com_margin is None else settings.com_margin,
        keep_contacts=settings.keep_contacts,
        friction=settings.friction,
        limit_margin=spec.limit_margin if settings.limit_margin is None else settings.limit_margin,
        regularization=settings.regularization,
    )


def resolved_settings(prepared: Prepared) -> ProblemSettings:
    """The same problem with every default written out: solved again, it gives the same result."""
    settings, impact, wanted = prepared.settings, prepared.impact, prepared.problem.requirements
    robot = settings.robot
    if names_a_path(robot, Path()):
        robot = str(Path(robot).expanduser().resolve())
    changes: dict[str, object] = {
        "robot": robot,
        "root": impact.robot.root,
        "package_dir": tuple(str(Path(p).expanduser().resolve()) for p in settings.package_dir),
        **_resolved_contacts(impact),
        "posture": None,
        "q": tuple(float(v) for v in impact.q),
        # One key for all contacts: where they differ it is left to robot.toml, as it was.
        "contact_pose": settings.contact_pose if wanted.other_poses else wanted.contact_pose,
        "support": tuple(f"{s.frame}:{s.kind}" for s in impact.supports),
        "support_compliance": impact.objective.compliance if impact.supports else None,
        "hold": wanted.hold,
        "base": wanted.base,
        "com": any(isinstance(c, CenterOfMassOverFeet) for c in prepared.problem.constraints),
        "com_margin": wanted.com_margin,
        "limit_margin": wanted.limit_margin,
        "weights": impact.metric.weights,
    }
    for key in _FILES:
        value = getattr(settings, key)
        in_package = value is None or value.startswith(EXAMPLE_PREFIX)
        changes[key] = value if in_package else str(Path(value).expanduser().resolve())
    if settings.armature is not None:
        changes["armature"] = _armature_by_joint(impact)
    return settings.model_copy(update=changes)


def _resolved_contacts(impact: ResolvedImpact) -> dict[str, object]:
    contact = impact.contact
    if not impact.objective.others:
        one = {"frame": contact.frame, "normal": contact.normal, "offset": contact.offset}
        return one | {"contact": None, "impulse": contact.impulse}
    texts = tuple(f"{c.frame}:{','.join(map(repr, c.normal))}:{c.impulse!r}" for c in impact.objective.contacts)
    return {"frame": None, "normal": None, "offset": None, "contact": texts}


def _armature_by_joint(impact: ResolvedImpact) -> str | dict[str, float]:
    robot = impact.robot
    first = {name: robot.model.idx_vs[robot.joint_id(name)] for name in robot.joint_names}
    values = {name: float(robot.armature[k]) for name, k in first.items()}
    return values if any(values.values()) else "none"


def dump_settings(settings: ProblemSettings) -> str:
    """Write settings as TOML, keys in the model's order, what is ``None`` left out.

    Raises:
        SpecError: The path of a file is not UTF-8.
    """
    lines = [f"schema = {toml(SCHEMA)}"]
    for key in ProblemSettings.model_fields:
        value = getattr(settings, key)
        if key != "schema_" and value is not None:
            try:
                lines.append(f"{key} = {toml(value)}")
            except UnicodeEncodeError:
                raise SpecError(
                    f"'{value}' is not UTF-8, as TOML has to be", where=key, hint="rename the file or folder"
                ) from None
    return "\n".join(lines) + "\n"
