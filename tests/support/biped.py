"""A biped with legs of six joints, whose feet have a given shape."""

from __future__ import annotations

from tests.support.urdfs import joint, link


def biped(foot: str, ankle_roll: bool = True) -> str:
    """Return the URDF of a biped; ``foot`` are the shapes of its links ``left_foot`` and ``right_foot``.

    The ankles are 0.66 m below the hips.  Without ``ankle_roll``, the legs have five joints.
    """
    hips = link("hips", 8.0, more=_box("0.16 0.2 0.12", 0.1))
    return (
        f'<robot name="biped">{hips}{_leg("left", 1, foot, ankle_roll)}{_leg("right", -1, foot, ankle_roll)}</robot>'
    )


def _leg(side: str, sign: int, foot: str, ankle_roll: bool) -> str:
    links = [
        ("hip1", "0 {y} 0", "0 0 1", (-1.0, 1.0), 0.5, ""),
        ("hip2", "0 0 -0.03", "1 0 0", (-0.6, 0.6), 0.5, ""),
        ("thigh", "0 0 -0.03", "0 1 0", (-1.6, 1.6), 2.0, _box("0.08 0.08 0.22", -0.15)),
        ("shin", "0 0 -0.3", "0 1 0", (0.0, 2.0), 1.5, _box("0.06 0.06 0.2", -0.14)),
        ("fork", "0 0 -0.3", "0 1 0", (-1.0, 1.0), 0.3, ""),
        ("foot", "0 0 0", "1 0 0", (-0.4, 0.4), 0.6, foot),
    ]
    if not ankle_roll:
        links[-2:] = [("foot", "0 0 -0.3", "0 1 0", (-1.0, 1.0), 0.9, foot)]
    parent, text = "hips", ""
    for name, xyz, axis, (low, high), mass, shapes in links:
        child, limit = f"{side}_{name}", f'<limit lower="{low}" upper="{high}" effort="100" velocity="5"/>'
        text += joint(f"to_{child}", f"{parent} {child}", axis, xyz.format(y=0.1 * sign), more=limit)
        text += link(child, mass, more=shapes)
        parent = child
    return text


def _box(size: str, z: float) -> str:
    return f'<collision><origin xyz="0 0 {z}"/><geometry><box size="{size}"/></geometry></collision>'
