"""C++ program that runs an exported controller in an exported world, compared with ``simulate``."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import pytest

from impact_posture.controller_export.export_controller import export_controller
from impact_posture.errors import InputError
from impact_posture.simulation.controllers.controller_factory import ControllerFactory
from impact_posture.simulation.controllers.driver import Driver
from impact_posture.simulation.controllers.task_formulations import nominal_posture
from impact_posture.simulation.metrics import measure
from impact_posture.simulation.run import run
from impact_posture.simulation.scenario_file import read_scenario
from impact_posture.simulation.setup import Setup, set_up
from impact_posture.simulation.world.scene import Sensors
from impact_posture.simulation.world_export import export_world
from tests.support.tools import need

SHORT = {"count": 1, "settle": 0.3, "dwell": 0.2, "pause": 0.05}
EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "cpp" / "closed_loop"


def quiet(name: str) -> Setup:
    """Set up a shipped scenario with noise-free sensors, one contact and a short wait."""
    scenario = read_scenario(name)
    sensors = scenario.sensors
    sensors = Sensors(force_frame=sensors.force_frame, force_cutoff=sensors.force_cutoff, delay=0.001)
    if scenario.contacts:
        return set_up(replace(scenario, sensors=sensors, contacts=replace(scenario.contacts, **SHORT)))
    push = replace(scenario.push, settle=0.3, after=0.2)
    return set_up(replace(scenario, sensors=sensors, push=push))


@pytest.mark.long(but=("aerial-vertical-1-0.001",))
@pytest.mark.parametrize(("name", "leads", "band"), [("aerial-vertical", "1", 1e-3), ("solo8-push", "", 1e-6)])
def test_the_program_agrees_with_simulate(name: str, leads: str, band: float, tmp_path: Path) -> None:
    need("g++")
    need("make")
    setup = quiet(name)
    export_world(setup, tmp_path / "world")
    formulation = Driver(setup, nominal_posture(setup)).controller.formulation
    export_controller(setup.robot, formulation, tmp_path / "controller", prefix="controller")
    program = tmp_path / "closed_loop"
    mujoco = find_spec("mujoco")
    assert mujoco is not None
    assert mujoco.origin is not None
    variables = [f"CONTROLLER={tmp_path / 'controller'}", f"MUJOCO={Path(mujoco.origin).parent}", f"OUT={program}"]
    strict = "CXXFLAGS=-O0 -Wall -Wextra -Wpedantic -Werror"
    subprocess.run(["make", "-s", "-C", EXAMPLE, *variables, f"LEADS={leads}", strict], check=True)
    output = subprocess.run([program, tmp_path / "world"], check=True, capture_output=True, text=True).stdout
    printed = dict(line.split(" ", 1) for line in output.splitlines())
    (record,) = run(ControllerFactory(setup), "nominal", only=1 if setup.scenario.push else None)
    wanted = measure(setup, record)
    for key in ("q_total_impact", "peak_jump", *(["peak_force"] if setup.scenario.contacts else [])):
        assert float(printed[key]) == pytest.approx(getattr(wanted, key), rel=band), key
    assert printed["contacts"] == "1 of 1"
    assert printed["ticks"].startswith(
        f"{record.series.t.size} relaxed {wanted.relaxed_ticks} held {wanted.failed_ticks}"
    )


def test_a_world_that_cannot_be_exported_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="thrown ball"):
        export_world(set_up(read_scenario("talos-throw")), tmp_path / "world")
    assert not (tmp_path / "world").exists()
