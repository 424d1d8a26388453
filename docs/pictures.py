"""Draw the pictures of README and pages into ``docs/images``.  Run with ``make pictures``."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image

IMAGES = Path(__file__).parent / "images"
# Arguments of ``optimize``, and for each figure the name of its picture.
PICTURES = [
    (
        "tilthex_arm --frame ee --normal 0 0 1",
        {name: name for name in ("ellipsoid", "postures", "jump", "nullspace", "classical")},
    ),
    ("anymal_c --normal 0 1 0 --normal-cone 20", {"ellipsoid": "cone"}),
    ("panda --normal -1 0 0 --search global", {"self_motion": "self_motion"}),
    ("talos --frame gripper_right_base_link --normal -1 0 0 --tradeoff", {"tradeoff": "tradeoff"}),
    ("tilthex_arm --frame ee --normal 0 0 1 --path", {"path": "path"}),
    ("ur5 --normal 0 0 1 --contact-pose aligned --speed 0.5 --path --strike", {"path": "strike"}),
]


# Command of the browser that takes a picture of the report of the first command.
BROWSER = ("chromium", "--headless=new", "--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
           "--hide-scrollbars", "--window-size=1280,1120", "--virtual-time-budget=8000")  # fmt: skip


def picture_report(page: Path) -> None:
    """Take a picture of a report at 60 % of the motion, if the browser is installed."""
    if shutil.which(BROWSER[0]) is None:
        print(f"{BROWSER[0]} is not installed: the picture of the report is not changed")
        return
    shot = page.with_suffix(".png")
    subprocess.run([*BROWSER, f"--screenshot={shot}", f"{page.as_uri()}#0.6"], check=True, stderr=subprocess.DEVNULL)
    with Image.open(shot) as picture:
        picture.convert("RGB").quantize(128).save(IMAGES / "report.png", optimize=True)


def main() -> None:
    """Run each command, and copy its figures into the documentation."""
    program = Path(sys.executable).with_name("impact-posture")
    for arguments, figures in PICTURES:
        with tempfile.TemporaryDirectory() as folder:
            out = Path(folder) / "result"
            more = ["--no-codegen", "--quiet", "--format", "png", "--out", out.name]
            subprocess.run([str(program), "optimize", *arguments.split(), *more], cwd=folder, check=True)
            if figures is PICTURES[0][1]:
                picture_report(out / "report.html")
            for figure, name in figures.items():
                shutil.copy(out / f"{figure}.png", IMAGES / f"{name}.png")
    with tempfile.TemporaryDirectory() as folder:
        for words in (["sweep", str(IMAGES.parent / "examples/press.toml"), "--quiet"], ["sweep", "show", "press"]):
            subprocess.run([str(program), *words], cwd=folder, check=True)
        shutil.copy(Path(folder) / "press/maps/map-0.png", IMAGES / "sweep.png")


if __name__ == "__main__":
    main()
