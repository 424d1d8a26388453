"""``robot.toml``: what URDF and SRDF cannot say about a robot, checked where it is read."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path
from typing import Annotated, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from impact_posture.errors import SpecError, nearest, not_one_of

SCHEMA = "impact-posture/robot/1"

Root = Literal["free-flyer", "fixed"]
ContactPose = Literal["full", "position", "aligned", "free", "box"]
SupportKind = Literal["point", "surface"]
Vector3 = tuple[float, float, float]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class ModelSpec(_Strict):
    """Where the model comes from: a path (relative to robot.toml) or ``example-robot-data:<path>``."""

    urdf: str | None = None
    srdf: str | None = None
    root: Root = "fixed"
    package_dirs: tuple[str, ...] = ()
    lock: tuple[str, ...] = ()
    lock_massless: bool = False
    # Some published URDFs carry links that no rigid body can be; their owner may insist.
    accept_inertias: bool = False


class PostureSpec(_Strict):
    """A named posture: joints by name (missing ones neutral), base pose ``[x, y, z, qx, qy, qz, qw]``."""

    base: tuple[float, float, float, float, float, float, float] | None = None
    joints: dict[str, float] = {}


class ContactSpec(_Strict):
    """The frame that touches by default, and what is held of which frame while the posture moves."""

    frame: str | None = None
    offset: Vector3 = (0.0, 0.0, 0.0)
    pose: ContactPose = "full"
    frames: dict[str, ContactPose] = {}


class SupportSpec(_Strict):
    """A foot that stays on the ground.

    ``point``: the contact point (frame origin plus ``offset``, in the frame) does not move.
    ``surface``: neither does the frame turn.
    ``size``: half extents (x, y) of a sole around that point, in the frame, meters; it widens the support polygon.
    """

    frame: str
    kind: SupportKind = "point"
    offset: Vector3 = (0.0, 0.0, 0.0)
    size: tuple[NonNegative, NonNegative] = (0.0, 0.0)


class ConstraintSpec(_Strict):
    """Constraints that the robot's optimizations carry unless told otherwise."""

    hold: tuple[str, ...] = ()
    level_base: bool = False
    com_over_feet: bool = False
    com_margin: NonNegative = 0.0
    limit_margin: NonNegative = 0.0


class LimitSpec(_Strict):
    """Limits that replace the URDF's: rad or m, rad/s or m/s, N·m or N."""

    position: dict[str, tuple[float, float]] = {}
    velocity: dict[str, Positive] = {}
    effort: dict[str, Positive] = {}


class ArmatureSpec(_Strict):
    """Rotor inertia reflected to the joint (gear ratio² × rotor inertia), kg·m² (kg for a prismatic joint)."""

    default: NonNegative | None = None
    joints: dict[str, NonNegative] = {}
    source: str = ""


class RotorSpec(_Strict):
    """One propeller: where it sits, which way it pushes, which way it turns (seen against the thrust)."""

    name: str
    position: Vector3
    direction: Vector3
    spin: Literal[-1, 1]


class PropulsionSpec(_Strict):
    """The propellers of an aerial robot: thrust ``c_f ω²``, drag moment ``-spin · drag_ratio · thrust``."""

    frame: str
    thrust_coefficient: Positive
    drag_ratio: NonNegative
    speed_min: NonNegative
    speed_max: Positive
    time_constant_up: Positive
    time_constant_down: Positive
    rotors: tuple[RotorSpec, ...]
    source: str = ""


class RobotSpec(_Strict):
    """The whole ``robot.toml``."""

    schema_: str = Field(default=SCHEMA, alias="schema")
    name: str | None = None
    kind: Literal["aerial", "arm", "quadruped", "humanoid", "mobile", "other"] = "other"
    description: str = ""
    model: ModelSpec = ModelSpec()
    default_posture: str | None = None
    postures: dict[str, PostureSpec] = {}
    contact: ContactSpec = ContactSpec()
    supports: tuple[SupportSpec, ...] = ()
    constraints: ConstraintSpec = ConstraintSpec()
    limits: LimitSpec = LimitSpec()
    armature: ArmatureSpec = ArmatureSpec()
    propulsion: PropulsionSpec | None = None
    sources: tuple[str, ...] = ()


_Model = TypeVar("_Model", bound=BaseModel)


def validate(cls: type[_Model], data: object, where: str) -> _Model:
    """Check ``data`` against a pydantic model; the first fault becomes one line with the nearest valid key."""
    try:
        return cls.model_validate(data)
    except ValidationError as error:
        # A misspelt key that must be there is misspelt first, and missing second.
        faults = error.errors()
        fault = next((f for f in faults if f["type"] == "extra_forbidden"), faults[0])
        path = ".".join(str(part) for part in fault["loc"])
        if fault["type"] == "extra_forbidden":
            known = _keys_at(cls, fault["loc"][:-1])
            close = ", ".join(nearest(str(fault["loc"][-1]), known))
            raise SpecError(f"unknown key '{path}'", where=where, hint=f"did you mean {close}?") from None
        what, hint = str(fault["msg"]), "correct the value"
        if fault["type"] == "literal_error":
            what, hint = not_one_of(fault["input"], re.findall(r"'([^']*)'", fault["ctx"]["expected"]))
        raise SpecError(f"key '{path}': {what}", where=where, hint=hint) from None


def _keys_at(cls: type[BaseModel], location: tuple[int | str, ...]) -> list[str]:
    model: type[BaseModel] = cls
    for part in location:
        field = model.model_fields.get(str(part))
        if field is None:
            continue
        annotation = field.annotation
        candidates = [annotation, *getattr(annotation, "__args__", ())]
        model = next((c for c in candidates if isinstance(c, type) and issubclass(c, BaseModel)), model)
    return [field.alias or name for name, field in model.model_fields.items()]


def read_toml(path: Path) -> dict[str, object]:
    """Read a TOML file; a missing or malformed one becomes one line."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise SpecError("no such file", where=str(path), hint="check the path") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SpecError(f"cannot be read ({error})", where=str(path), hint="check the file") from None
    except RecursionError:
        raise SpecError("is nested too deeply", where=str(path), hint="correct the syntax") from None
    except tomllib.TOMLDecodeError as error:
        raise SpecError(f"is not valid TOML ({error})", where=str(path), hint="correct the syntax") from None


def with_tuples(value: object) -> object:
    """The same data with every list a tuple, as strict models want it."""
    if isinstance(value, dict):
        return {key: with_tuples(inner) for key, inner in value.items()}
    return tuple(with_tuples(inner) for inner in value) if isinstance(value, list) else value


def read_spec(path: Path, over: Path | None = None) -> RobotSpec:
    """Read and check a ``robot.toml``; what it does not say is taken from ``over``, paths relative to either file.

    A file that names another URDF describes another robot: nothing is taken over then.
    """
    data = read_toml(path)
    model = data.get("model", {})
    if over is not None and not (isinstance(model, dict) and "urdf" in model):
        data = _overlay(_absolute_paths(read_toml(over), over.parent), data)
    # Before the keys: those of another schema are not misspelt.
    schema = data.get("schema", SCHEMA)
    if schema != SCHEMA:
        raise SpecError(f"schema '{schema}'", where=str(path), hint=f'write schema = "{SCHEMA}"')
    return validate(RobotSpec, data, str(path))


def _overlay(below: dict[str, object], above: dict[str, object]) -> dict[str, object]:
    """Merge tables; lists, values and the armature as a whole are replaced."""
    merged = dict(below)
    for key, value in above.items():
        old = merged.get(key)
        if isinstance(old, dict) and isinstance(value, dict) and key != "armature":
            merged[key] = _overlay(old, value)
        else:
            merged[key] = value
    return merged


def _absolute_paths(data: dict[str, object], folder: Path) -> dict[str, object]:
    model = data.get("model")
    if isinstance(model, dict):
        for key in ("urdf", "srdf"):
            text = model.get(key)
            if isinstance(text, str) and ":" not in text:
                model[key] = str(folder / text)
    return data
