"""Robots that users load by name: each folder contains a ``robot.toml``, and some contain a URDF and SRDF."""

from __future__ import annotations

from pathlib import Path
from typing import Final

DATA: Final = Path(__file__).resolve().parent
"""Folder that contains ``<name>/robot.toml``."""
