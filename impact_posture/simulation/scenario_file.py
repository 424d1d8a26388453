"""``scenario.toml``: an experiment as a file, which is checked when it is read."""

from __future__ import annotations

import os
from pathlib import Path

from impact_posture.config.toml_tables import read_toml, validate
from impact_posture.errors import InputError, ScenarioNotFound, SpecError, shown
from impact_posture.robot.robot_loader import from_folder
from impact_posture.simulation.scenario import SCHEMA, Scenario, ScenarioTable

SHIPPED = Path(__file__).parent / "scenarios"


def known_scenarios() -> tuple[str, ...]:
    """Return the sorted names of the scenarios that need no path."""
    return tuple(sorted(path.stem for path in SHIPPED.glob("*.toml")))


def read_scenario(scenario: str | Path) -> Scenario:
    """Read a shipped scenario by name, or another one from its file.  Paths in a file start from its folder.

    Raises:
        ScenarioNotFound: There is no such scenario.  The error lists the nearest names.
        SpecError: The file cannot be read, has an unknown key, or a value does not fit.
    """
    path = scenario_path(scenario)
    data = read_toml(path)
    # The schema comes first, because the keys of another schema are not misspelt.
    schema = data.get("schema", SCHEMA)
    if schema != SCHEMA:
        raise SpecError(f"schema '{shown(schema)}'", where=str(path), hint=f'write schema = "{SCHEMA}"')
    data = from_folder(data, path.resolve().parent, ("srdf", "config", "armature", "posture"))
    try:
        table = validate(ScenarioTable, data, str(path))
    except SpecError:
        raise
    except InputError as error:
        where = f"{path}, {error.where}" if error.where else str(path)
        raise SpecError(error.what, where=where, hint=error.hint) from None
    return Scenario(**vars(table), source=str(path))


def scenario_path(scenario: str | Path) -> Path:
    """Return the path of a scenario file.

    Raises:
        ScenarioNotFound: There is no such scenario.  The error lists the nearest names.
    """
    if isinstance(scenario, str):
        if scenario in known_scenarios():
            return SHIPPED / f"{scenario}.toml"
        if "/" not in scenario and not scenario.endswith(".toml") and not os.path.isfile(scenario):
            raise ScenarioNotFound(scenario, known_scenarios(), hint="(or give a path to a .toml)")
    return Path(scenario).expanduser()
