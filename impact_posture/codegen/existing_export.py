"""Check whether a folder already contains the export of an objective."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

from impact_posture.codegen.compile_and_check import compile_and_check
from impact_posture.codegen.export import Export, default_prefix
from impact_posture.codegen.manifest_builder import build_manifest
from impact_posture.impact.worst_case_objective import WorstCaseObjective
from impact_posture.system.folder_record import changed_files, own_files
from impact_posture.system.libraries import library_path
from impact_posture.system.text_files import read_text
from impact_posture.system.toolchain import find_compiler

# Keys of a manifest whose values depend on more than the objective.
_OTHERS = ("posture", "compression", "stack_bytes")


def existing_export(objective: WorstCaseObjective, out: Path, *, build: bool) -> Export | None:
    """Return the unchanged export of an objective in the folder ``out``; ``None`` if it is missing or changed.

    Posture and compression of the impact may differ from the manifest.  All other content must equal the manifest
    that :func:`~impact_posture.codegen.export.export` would write.  If ``build`` is true, the library is built and
    checked.

    Raises:
        CompilerError: The compiler failed, or the results of the compiled code are wrong.
    """
    prefix = default_prefix([objective])
    files = own_files(out, "export")
    if f"{prefix}.json" not in files or not all((out / name).is_file() for name in files) or changed_files(out):
        return None
    try:
        manifest = json.loads(read_text(out / f"{prefix}.json"))
        content = _comparable(manifest)
    except (OSError, LookupError, ValueError, TypeError, AttributeError, RecursionError):
        return None
    # Convert the new manifest to JSON and back, because the manifest in the file has lists instead of tuples.
    if content != _comparable(json.loads(json.dumps(build_manifest([objective], prefix, None, None)))):
        return None
    existing = Export(out, objective.robot, tuple(out / name for name in files), manifest, requested=build)
    if not build or find_compiler() is None:
        return existing
    agreement = compile_and_check(out, prefix, [objective], keep=True)
    return replace(existing, agreement=agreement, library=library_path(out, prefix))


def _comparable(manifest: dict[str, Any]) -> dict[str, Any]:
    """Return the part of a manifest that the objective alone determines."""
    rest = {key: value for key, value in manifest.items() if key not in _OTHERS}
    return rest | {"symbols": {name: symbol for name, symbol in rest["symbols"].items() if name != "posture"}}
