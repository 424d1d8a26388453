"""From the options of a command to the library's request: the same for every command that has them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from impact_posture_cli.checks import Three, Two
from impact_posture_cli.options import (
    MetricKind,
    NormalFrame,
    ObjectiveKind,
    RootKind,
    check_contact,
    check_supports,
)

if TYPE_CHECKING:
    from impact_posture.impact.request import ImpactRequest
    from impact_posture.robot.robot_loader import LoadOptions


def load_options(
    *,
    root: RootKind | None,
    package_dir: list[str] | None,
    srdf: str | None,
    config: str | None,
    armature: list[str] | None,
    lock: list[str] | None,
    lock_massless: bool,
) -> LoadOptions:
    """How to load the robot."""
    from impact_posture.impact.parsing import parse_armature
    from impact_posture.robot.robot_loader import LoadOptions

    return LoadOptions(
        root=root,
        package_dirs=tuple(package_dir or ()),
        srdf=srdf,
        config=config,
        armature=parse_armature(armature or ()),
        lock=tuple(lock or ()),
        lock_massless=lock_massless,
    )


def impact_request(
    robot: str,
    *,
    frame: str | None,
    normal: Three | None,
    offset: Three | None,
    normal_frame: NormalFrame,
    contact: list[str] | None,
    impulse: float,
    posture: str | None,
    support: list[str] | None,
    no_support: bool,
    metric: MetricKind,
    weights: str | None,
    objective: ObjectiveKind,
    normal_cone: float,
    bilateral: bool = False,
    armature_range: Two | None = None,
    payload: list[str] | None = None,
    speed: float,
    restitution: float,
    root: RootKind | None,
    package_dir: list[str] | None,
    srdf: str | None,
    config: str | None,
    armature: list[str] | None,
    lock: list[str] | None,
    lock_massless: bool,
) -> ImpactRequest:
    """What impact is meant.

    Raises:
        typer.BadParameter: Wrong from the command line alone; exit code 2.
    """
    check_contact(frame, normal, contact)
    supports = check_supports(support, no_support)
    from impact_posture.impact.parsing import parse_payload
    from impact_posture.impact.request import ImpactRequest

    return ImpactRequest(
        robot=robot,
        load=load_options(
            root=root,
            package_dir=package_dir,
            srdf=srdf,
            config=config,
            armature=armature,
            lock=lock,
            lock_massless=lock_massless,
        ),
        frame=frame,
        normal=normal,
        offset=offset,
        normal_frame=normal_frame,
        contacts=tuple(contact or ()),
        bilateral=bilateral,
        impulse=impulse,
        posture=posture,
        supports=supports,
        metric=metric,
        weights=weights,
        objective=objective,
        normal_cone=normal_cone,
        armature_range=armature_range,
        payloads=tuple(parse_payload(text) for text in payload or ()),
        speed=speed,
        restitution=restitution,
    )
