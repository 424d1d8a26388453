"""Read supports from their names, and check that an impact is possible with these supports."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import get_args

import numpy as np

from impact_posture.collision.foot_shape import measured_sole
from impact_posture.config.problem_settings import SupportKind
from impact_posture.errors import ContactError, FrameNotFound, InputError
from impact_posture.impact.impact_contact import ImpactContact, point_on
from impact_posture.robot.guessed_parts import feet
from impact_posture.robot.robot import Robot
from impact_posture.robot.robot_spec import Support


def resolve_supports(robot: Robot, texts: Sequence[str] | None) -> tuple[Support, ...]:
    """Turn texts ``FRAME[:point|surface]`` into supports; for ``None``, return the supports in ``robot.toml``.

    If ``robot.toml`` lists the frame, the offset and size in ``robot.toml`` are used.  The kind (point or
    surface) in ``robot.toml`` is used unless the text states a kind.  The sole of a surface without size is measured.

    Raises:
        FrameNotFound: The robot has no such frame; the error lists the nearest names.
        InputError: A frame is given twice.
    """
    known = {support.frame: support for support in robot.spec.supports}
    supports = robot.spec.supports if texts is None else tuple(_support(robot, text, known) for text in texts)
    for support in supports:
        if sum(s.frame == support.frame for s in supports) > 1:
            raise InputError(f"frame '{support.frame}' is given twice", where="support", hint="remove one")
        point_on(robot, support.frame, support.offset)
    return tuple(measured_sole(robot, s) if s.kind == "surface" and not s.has_sole else s for s in supports)


def _support(robot: Robot, text: str, known: Mapping[str, Support]) -> Support:
    frame, kind = text, None
    for candidate in get_args(SupportKind):
        if text.endswith(f":{candidate}"):
            frame, kind = text.removesuffix(f":{candidate}"), candidate
    if frame not in robot.frame_names:
        names = dict.fromkeys((*feet(robot), *robot.frame_names))
        raise FrameNotFound(frame, names, where="support", hint="(or FRAME:point, FRAME:surface)")
    base = known.get(frame, Support(frame))
    return Support(frame, kind or base.kind, base.offset, base.size)


def refuse_held(robot: Robot, contact: ImpactContact, supports: Sequence[Support]) -> None:
    """Raise ``ContactError`` if a support holds the contact point, so that only the compliance could yield."""
    point = point_on(robot, contact.frame, contact.offset)
    for support in supports:
        foot = point_on(robot, support.frame, support.offset)
        if foot.joint != point.joint:
            continue
        same_point = float(np.linalg.norm(foot.position - point.position)) < 1e-6
        if support.kind == "surface" or support.frame == contact.frame or same_point:
            what = f"the contact point is held by the support at '{support.frame}'"
            hint = "choose another frame, name the other `support` frames, or choose no `support`"
            raise ContactError(what, where=f"frame {contact.frame}", hint=hint)


def refuse_rigid(robot: Robot, supports: Sequence[Support]) -> None:
    """Raise ``InputError`` if the robot has supports and all joints are locked, because then nothing moves."""
    if supports and np.isinf(robot.model.armature[6:]).all():
        what = f"all joints of {robot.name} are locked and its feet stay, so nothing moves in an impact"
        hint = "choose reflected or link, or no `support` for a robot off the ground"
        raise InputError(what, where="joint_model", hint=hint)
