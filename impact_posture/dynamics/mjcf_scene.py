"""What a simulation adds to a written model: surfaces, shapes on the robot, contact pairs, ties, motors.

Bodies keep the inertias that the writer gave them: shapes weigh nothing.  Nothing touches anything but in a pair.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from impact_posture.dynamics.mjcf import Mjcf
from impact_posture.dynamics.mjcf_text import numbers, pose

Vector = NDArray[np.float64]

# Joint index that stands for the world.
WORLD = 0


class Additions:
    """Adds to a model; :meth:`model` gives what it has become.

    Bodies are named by the index of Pinocchio's joint that moves them, :data:`WORLD` for none; values of attributes
    are MJCF's.

    Args:
        written: The robot.
    """

    def __init__(self, written: Mjcf) -> None:
        self._written = written
        self._root = ET.fromstring(written.xml)
        names = {name: joint for joint, name in written.bodies.items()}
        self._bodies = {names[str(body.get("name"))]: body for body in self._root.iter("body")}
        self._bodies[WORLD] = self._section("worldbody")

    def option(self, **attributes: str) -> None:
        """Set attributes of ``<option>``."""
        self._section("option").attrib.update(attributes)

    def flag(self, **attributes: str) -> None:
        """Set attributes of ``<option><flag>``."""
        option = self._section("option")
        flag = option.find("flag")
        (ET.SubElement(option, "flag") if flag is None else flag).attrib.update(attributes)

    def stops(self, **attributes: str) -> None:
        """Set attributes of every joint, such as ``solreflimit``."""
        ET.SubElement(self._section("default"), "joint", attributes)

    def plane(self, name: str, point: Vector, normal: Vector) -> None:
        """Add an endless plane to the world.

        Args:
            name: Of the geom.
            point: A point on it, shape (3,).
            normal: Unit, out of it, shape (3,).
        """
        upright = pin.Quaternion.FromTwoVectors(np.array([0.0, 0.0, 1.0]), np.array(normal)).matrix()
        self._geom(WORLD, name, "plane", (1.0, 1.0, 1.0), pin.SE3(upright, np.array(point)))

    def shape(
        self, joint: int, name: str, kind: Literal["sphere", "box"], size: Sequence[float], placement: pin.SE3
    ) -> None:
        """Add a massless shape to a body.

        Args:
            joint: Which body.
            name: Of the geom.
            kind: ``sphere`` or ``box``.
            size: Radius, or half extents, meters.
            placement: In the joint's frame.
        """
        self._geom(joint, name, kind, size, placement)

    def site(self, joint: int, name: str, placement: pin.SE3) -> None:
        """Add a site to a body."""
        ET.SubElement(self._bodies[joint], "site", {"name": name, **pose(placement)})

    def pair(self, first: str, second: str, **attributes: str) -> None:
        """Let two geoms touch."""
        ET.SubElement(self._section("contact"), "pair", {"geom1": first, "geom2": second, **attributes})

    def tie(self, kind: Literal["connect", "weld"], first: str, second: str, **attributes: str) -> None:
        """Hold two sites together: their origins, or their poses."""
        ET.SubElement(self._section("equality"), kind, {"site1": first, "site2": second, **attributes})

    def motor(self, name: str, gear: Iterable[float], **where: str) -> None:
        """Add a motor: its control times ``gear`` pushes a ``joint``, or is a wrench at a ``site``, in its axes."""
        ET.SubElement(self._section("actuator"), "general", {"name": name, "gear": numbers(gear), **where})

    def model(self) -> Mjcf:
        """The model with everything that was added."""
        ET.indent(self._root)
        return replace(self._written, xml=ET.tostring(self._root, encoding="unicode") + "\n")

    def _geom(self, joint: int, name: str, kind: str, size: Sequence[float], placement: pin.SE3) -> None:
        attributes = {"name": name, "type": kind, "size": numbers(size), **pose(placement)}
        # Weightless, and deaf to all but pairs.
        attributes |= {"mass": "0", "contype": "0", "conaffinity": "0"}
        ET.SubElement(self._bodies[joint], "geom", attributes)

    def _section(self, tag: str) -> ET.Element:
        found = self._root.find(tag)
        return ET.SubElement(self._root, tag) if found is None else found
