"""The robots known by name: a folder each, with ``robot.toml`` and, where it is ours, URDF and SRDF."""

from __future__ import annotations

from pathlib import Path
from typing import Final

DATA: Final = Path(__file__).resolve().parent
"""Folder that holds ``<name>/robot.toml``."""
