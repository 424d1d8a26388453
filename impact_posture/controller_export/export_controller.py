"""Write a controller as C code to a folder: sources, header, DAQP, the gradient, and a manifest."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import casadi as ca

from impact_posture.codegen.c_names import c_identifier, check_prefix
from impact_posture.codegen.export import WrittenCode
from impact_posture.codegen.export import export as export_gradient
from impact_posture.codegen.manifest_reader import identity
from impact_posture.config.checked import checked
from impact_posture.controller_export.compiled_controller import CompiledController
from impact_posture.controller_export.controller_manifest import SCHEMA, build_controller
from impact_posture.controller_export.controller_parameters import Field, parameters
from impact_posture.controller_export.controller_source import build_files, render
from impact_posture.controller_export.controller_structure import Structure, structure_of
from impact_posture.controller_export.daqp_sources import FILES, VERSION, daqp_sources, renamed
from impact_posture.controller_export.path_source import path_reference, render_path
from impact_posture.dynamics.model_parameters import ModelParameters
from impact_posture.errors import InputError
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.path.posture_path import PosturePath
from impact_posture.robot.robot import Robot
from impact_posture.system.libraries import library_path
from impact_posture.system.output_folder import whole_folder, write_whole
from impact_posture.system.toolchain import find_compiler
from impact_posture.tsid.state import PERIOD
from impact_posture.tsid.task_formulation import TaskFormulation
from impact_posture.version import __version__

RUN_SCHEMA = "impact-posture/controller-run/1"


@dataclass(frozen=True)
class ControllerExport(WrittenCode):
    """Folder and manifest of an exported C controller."""

    @property
    def verdict(self) -> str:
        """Result of the export in one line."""
        if self.library is not None:
            return f"{self.library.name}: built"
        return f"build: make -C {self.out} (or codegen --compile)"

    def to_dict(self) -> dict[str, Any]:
        """Return the JSON document that ``codegen --controller --json`` prints."""
        return {
            "schema": RUN_SCHEMA,
            "out": str(self.out),
            "prefix": self.prefix,
            "files": [path.relative_to(self.out).as_posix() for path in self.files],
            "library": None if self.library is None else self.library.name,
            "tasks": self.manifest["tasks"],
            "parameters": self.manifest["parameters"],
            "verdict": self.verdict,
        }

    def load(self) -> CompiledController:
        """Load the library, which runs its code.  If the library is missing, build the library first."""
        return CompiledController.load(self.out, robot=self.robot)


@checked
def export_controller(
    robot: Robot,
    formulation: TaskFormulation,
    out: str | Path | None = None,
    *,
    objective: WorstCaseObjective | None = None,
    prefix: str | None = None,
    period: float = PERIOD,
    daqp: str | Path | None = None,
    build: bool = False,
    force: bool = False,
    generated: Sequence[str] = (),
    shared: bool = False,
    path: PosturePath | None = None,
) -> ControllerExport:
    """Write the controller of a formulation as C99 code to a folder, completely or not at all.

    The tasks, contacts and sizes are fixed in the code.  Gains, weights, limits and targets are parameters that a
    program can set; their defaults are the values of the formulation.

    Args:
        robot: The robot.
        formulation: Tasks of this package, contacts and limits.
        out: The folder; by default, ``./<prefix>-c``.
        objective: The objective whose gradient an impact-robust posture task or a reference flow follows.
        prefix: Beginning of all C names; by default, the name of the robot and ``controller``.
        period: Expected time between ticks, s.
        daqp: Folder with the sources of DAQP; with ``None``, they are downloaded.
        build: Also build ``lib<prefix>.so`` in the folder, if there is a compiler.
        force: Replace an earlier export.
        generated: Additional compiler flags for the sources that are generated from the model.
        shared: Make armature and joint placements a parameter, ``numbers``.  Robots that differ only in these numbers
            can share the code, which then also contains the gradient.
        path: The folder also contains the references along this path
            (:class:`~impact_posture.path.path_reference.PathReference`) and an example.  If the path strikes, its
            contact must be the contact of ``objective``.

    Raises:
        InputError: A task or joint has no C code, the gradient or the sources of DAQP are missing, or the path does
            not fit the controller.
        OutputError: The folder exists and ``force`` is false, is not an export, or cannot be written.
        CompilerError: The compiler failed.
    """
    prefix = c_identifier(robot.name, "controller") if prefix is None else check_prefix(prefix)
    structure = structure_of(robot, formulation)
    if (structure.robust is None and structure.flow is None) != (objective is None):
        what = "the posture task has no objective" if objective is None else "no task uses the objective"
        needed = "the objective whose gradient the posture task follows"
        hint = f"give {needed}" if objective is None else "give a posture task with a gradient"
        raise InputError(what, where="controller export", hint=hint)
    along = {} if path is None else render_path(structure, path_reference(robot, path, objective), prefix)
    sources = daqp_sources(Path(daqp) if daqp else None)
    fields = tuple(parameters(structure, period))
    if shared:
        numbers = ModelParameters(robot.model).values
        fields = (*fields, Field("numbers", "finite", "armature and placements of the joints", numbers))
    manifest = _manifest(structure, fields, prefix)
    metric = f"{prefix}_metric" if objective is not None else None
    more = [name for name, exists in (("metric", objective), ("path", path)) if exists is not None]
    parts = ("defaults", "dynamics", "relaxation", *more, "daqp")
    manifest["sources"] = [f"{prefix}_{name}.c" for name in parts]
    lean = objective if shared else None
    texts = render(structure, fields, prefix, identity(manifest), metric, lean, shared=shared)
    texts |= renamed(sources, prefix) | along
    texts[f"{prefix}.json"] = json.dumps(manifest, indent=2, allow_nan=False) + "\n"
    texts |= {} if objective is None or metric is None or shared else _metric(objective, metric)
    texts |= build_files(prefix, manifest["sources"])
    out = Path(out or f"{prefix}-c")
    library = library_path(out, prefix)
    products = (library.name, f"{library.name}.sha256")
    with whole_folder(out, force=force, kind="export", products=products) as folder:
        for name, text in texts.items():
            write_whole(folder / name, text)
        (folder / "daqp").mkdir()
        for name in FILES:
            (folder / "daqp" / name).write_bytes(sources[name])
        if build and find_compiler() is not None:
            build_controller(folder, manifest, generated)
        names = sorted(path.relative_to(folder) for path in folder.rglob("*") if path.is_file())
    built = library if library.is_file() else None
    return ControllerExport(out, robot, tuple(out / name for name in names), manifest, built)


@lru_cache(maxsize=2)
def _metric(objective: WorstCaseObjective, prefix: str) -> dict[str, str]:
    """Return file name → text of the exported gradient: source, header and manifest, without the examples."""
    with TemporaryDirectory() as folder:
        export_gradient(objective, Path(folder), prefix=prefix, check=False)
        names = [f"{prefix}.{ending}" for ending in ("c", "h", "json")]
        return {name: (Path(folder) / name).read_text(encoding="utf-8") for name in names}


def _manifest(s: Structure, fields: Sequence[Field], prefix: str) -> dict[str, Any]:
    robot = s.robot
    return {
        "schema": SCHEMA,
        "prefix": prefix,
        "real": "double",
        "robot": robot.name,
        "model_sha256": robot.model_sha256,
        "joint_names": list(robot.joint_names),
        "convention": robot.convention,
        "armature": robot.armature.tolist(),
        "nq": robot.nq,
        "nv": robot.nv,
        "q_names": list(robot.q_names),
        "v_names": list(robot.tangent_names),
        "u_names": list(s.actuators.names),
        "sizes": s.sizes,
        "parameters": {f.name: int(f.value.size) for f in fields},
        "tasks": [{"name": t.name, "rows": t.size} for t in s.tasks],
        "levels": [[name, int(rows)] for name, rows in zip(s.levels, s.tables["level_rows"], strict=True)],
        "posture": None if s.formulation.posture is None else s.formulation.posture.name,
        "bounds": list(s.bounds),
        "versions": {"impact_posture": __version__, "casadi": str(ca.CasadiMeta.version()), "daqp": VERSION},
    }
