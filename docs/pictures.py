"""Draw the pictures that README and pages show, into ``docs/images``.  Run: ``make pictures``."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

IMAGES = Path(__file__).parent / "images"
# A command, and which of its figures go where.
PICTURES = [
    (
        "tilthex_arm --frame ee --normal 0 0 1",
        {name: name for name in ("ellipsoid", "postures", "jump", "nullspace", "classical")},
    ),
    ("anymal_c --normal 0 1 0 --normal-cone 20", {"ellipsoid": "cone"}),
    ("panda --normal -1 0 0 --search global", {"self_motion": "self_motion"}),
    ("talos --frame gripper_right_base_link --normal -1 0 0 --tradeoff", {"tradeoff": "tradeoff"}),
    ("tilthex_arm --frame ee --normal 0 0 1 --path", {"path": "path"}),
]


def main() -> None:
    """Run each command and copy its figures."""
    program = Path(sys.executable).with_name("impact-posture")
    for arguments, figures in PICTURES:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "result"
            more = ["--no-codegen", "--quiet", "--format", "png", "--out", str(out)]
            subprocess.run([str(program), "optimize", *arguments.split(), *more], check=True)
            for figure, name in figures.items():
                shutil.copy(out / f"{figure}.png", IMAGES / f"{name}.png")


if __name__ == "__main__":
    main()
