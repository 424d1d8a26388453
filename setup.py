"""Find the packages: a folder that is added ships without being listed.  Everything else is in pyproject.toml."""

from setuptools import find_packages, setup

# setuptools' own finder cannot rename a folder.
FOLDERS = {"impact_posture": "impact_posture", "impact_posture_cli": "cli", "impact_posture_robots": "robots"}

setup(
    package_dir=FOLDERS,
    packages=[*FOLDERS, *(f"{name}.{inner}" for name, folder in FOLDERS.items() for inner in find_packages(folder))],
)
