"""The report of any output folder, made again."""

from __future__ import annotations

from pathlib import Path

from impact_posture.errors import SpecError


def rewrite_report(folder: Path, *, meshes: bool = False) -> Path:
    """Write ``report.html`` of a result, run or comparison again; return its path.

    Args:
        folder: A folder that ``optimize``, ``simulate`` or ``compare`` wrote.
        meshes: Pass on the meshes of the user's own URDF, too.

    Raises:
        SpecError: The folder is none of these, or its files do not fit.
        ImpactPostureError: Its robot or scenario cannot be loaded any more.
        OutputError: The report cannot be written.
    """
    if (folder / "result.json").is_file():
        from impact_posture.result_folder import rewrite_report

        return rewrite_report(folder, meshes=meshes)
    if any((folder / name).is_file() for name in ("run.json", "comparison.json")):
        from impact_posture.experiment.run_reports import write_run_report

        return write_run_report(folder, meshes=meshes)
    what = "holds no result.json, run.json or comparison.json"
    raise SpecError(what, where=str(folder), hint="name a folder that optimize, simulate or compare wrote")
