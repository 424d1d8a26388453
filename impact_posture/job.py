"""The main job from end to end: settings in, result folder out; and a result folder read back."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from impact_posture.codegen.export import Export, export
from impact_posture.errors import CompilerError, SpecError
from impact_posture.folder import whole_folder
from impact_posture.plot import PathData, ResultView, TradeOffData, draw_all
from impact_posture.posture.path import NullSpacePath, null_space_path
from impact_posture.posture.result import result_arrays, result_document
from impact_posture.posture.robustness import Robustness
from impact_posture.posture.settings import Prepared, dump_settings, prepare, read_settings, resolved_settings
from impact_posture.posture.solve import PostureSolution
from impact_posture.posture.tradeoff import TradeOff
from impact_posture.robot.postures import write_posture

# What makes a folder an earlier result, which --force may replace.
MARKS = ("result.json",)
FORMATS = ("png", "svg", "pdf")


@dataclass(frozen=True)
class Written:
    """What :func:`write_result` left behind.

    Attributes:
        out: The folder.
        document: The content of ``result.json``.
        export: The C export, or ``None``.
        compiler_error: Why the C code could not be built and compared; empty if it was, or no compiler is there.
    """

    out: Path
    document: dict[str, object]
    export: Export | None
    compiler_error: str = ""


def default_out(prepared: Prepared) -> Path:
    """``./<robot>-<frame>``."""
    return Path(f"{prepared.impact.robot.name}-{prepared.impact.contact.frame}".replace("/", "_"))


def write_result(
    prepared: Prepared,
    solution: PostureSolution,
    out: Path,
    *,
    robustness: Robustness | None = None,
    tradeoff: TradeOff | None = None,
    force: bool = False,
    codegen: bool = True,
    formats: Sequence[str] = FORMATS,
) -> Written:
    """Write the result folder, whole or not at all.

    Raises:
        OutputError: It exists without ``force``, or cannot be written.
    """
    document = result_document(prepared, solution, robustness, tradeoff)
    path = null_space_path(solution.problem, solution.initial, solution.q)
    made: Export | None = None
    failure = ""
    with whole_folder(out, force=force, marks=MARKS) as folder:
        _write_json(folder / "result.json", document)
        np.savez_compressed(folder / "result.npz", **result_arrays(solution, path, tradeoff))  # type: ignore[arg-type]
        _write_json(folder / "posture.json", write_posture(prepared.impact.robot, solution.q))
        (folder / "problem.toml").write_text(dump_settings(resolved_settings(prepared)), encoding="utf-8")
        draw_all(_view(prepared, solution.initial, solution.q, path, document), folder, formats)
        if codegen:
            (folder / "c").mkdir()
            try:
                made = export(prepared.impact.objective, folder / "c", posture=solution.q)
            except CompilerError as error:
                # The posture is worth keeping whatever the compiler says; the user hears of it.
                failure = error.line
                made = export(prepared.impact.objective, folder / "c", posture=solution.q, force=True, check=False)
    return Written(out, document, made, failure)


def _view(
    prepared: Prepared,
    initial: np.ndarray,
    optimal: np.ndarray,
    path: NullSpacePath,
    document: dict[str, Any],
) -> ResultView:
    impact = prepared.impact
    return ResultView(
        robot=impact.robot,
        objective=impact.objective,
        q_initial=initial,
        q_optimal=optimal,
        speed=impact.speed,
        restitution=impact.restitution,
        path=PathData(s=path.s, H=path.H, G=path.G, V=path.V, S=path.S),
        tradeoff=_tradeoff_data(document.get("tradeoff", [])),
    )


def _tradeoff_data(points: Sequence[dict[str, Any]]) -> TradeOffData | None:
    """``tradeoff`` of a ``result.json`` as it is drawn; ``None`` where there is nothing to trade."""
    if len(points) < 2:
        return None
    keys = ("within", "distance", "objective", "H", "G", "V", "S")
    columns = {key: np.array([np.nan if p[key] is None else p[key] for p in points], dtype=float) for key in keys}
    knee = next((k for k, p in enumerate(points) if p["knee"]), None)
    return TradeOffData(**columns, certified=np.array([bool(p["certified"]) for p in points]), knee=knee)


def _write_json(path: Path, document: dict[str, object]) -> None:
    # allow_nan=False: a result with NaN in it must fail here and not at its reader.
    path.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def load_view(folder: Path) -> ResultView:
    """Read a result folder back as what its pictures are drawn from.

    Raises:
        SpecError: It is no result folder, or the robot is not the one it was made with.
    """
    if not (folder / "result.json").is_file():
        raise SpecError("holds no result.json", where=str(folder), mend="name a folder that optimize wrote")
    try:
        document = json.loads((folder / "result.json").read_text(encoding="utf-8"))
        prepared = prepare(read_settings(folder / "problem.toml"))
        with np.load(folder / "result.npz") as arrays:
            path = NullSpacePath(
                **{key: arrays[f"path_{key}"] for key in ("q", "s", "H", "G", "V", "S", "objective")}
            )
        robot, recorded = prepared.impact.robot, str(document["robot"]["model_sha256"])
        if recorded != robot.model_sha256:
            raise SpecError(
                f"was made with another model of {robot.name} (sha256 {recorded[:12]}…)",
                where=str(folder),
                mend="run optimize again, or use the URDF and armature of then",
            )
        initial, optimal = (
            robot.check_posture(document[key]["q"], limits=False, where=f"{folder / 'result.json'}: {key}.q")
            for key in ("initial", "optimal")
        )
        return _view(prepared, initial, optimal, path, document)
    except RecursionError:
        raise SpecError("is nested too deeply", where=str(folder), mend="run optimize again") from None
    except (ValueError, KeyError, TypeError, AttributeError, IndexError, OSError, EOFError, BadZipFile) as error:
        raise SpecError(
            f"is no whole result ({type(error).__name__}: {error})", where=str(folder), mend="run optimize again"
        ) from None
