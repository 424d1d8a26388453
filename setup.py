"""Find the packages, so that a new folder is shipped without being listed.  Everything else is in pyproject.toml."""

from setuptools import find_packages, setup

# The automatic discovery of setuptools cannot rename a folder.
FOLDERS = {"impact_posture": "impact_posture", "impact_posture_cli": "cli", "impact_posture_robots": "robots"}

setup(
    package_dir=FOLDERS,
    packages=[*FOLDERS, *(f"{name}.{inner}" for name, folder in FOLDERS.items() for inner in find_packages(folder))],
)
