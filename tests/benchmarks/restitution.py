"""What rebound each contact law has, measured in the simulated world.

Run: make calibration, or
python -m tests.benchmarks.restitution [--write]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from impact_posture.dynamics.mjcf import import_mujoco
from impact_posture.errors import ImpactPostureError
from impact_posture.simulation.scene import ContactLaw, Physics
from tests.benchmarks.bounce import ideal_restitution, measure_restitution

PAGE = Path(__file__).parents[2] / "docs" / "generated" / "restitution.md"
TIMES = (0.002, 0.005, 0.01, 0.02)
DAMPINGS = (0.1, 0.3, 0.5, 0.7, 1.0, 2.0)
STEPS = (2.5e-4, 1e-3)
SPEED = 0.5


def main() -> int:
    """Print the table; with ``--write`` also leave it for the documentation."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help=f"also write {PAGE.name} of the documentation")
    args = parser.parse_args()
    try:
        import_mujoco()
    except ImpactPostureError as error:
        print(error, file=sys.stderr)
        return 1
    page = "\n".join(table())
    print(page)
    if args.write:
        PAGE.write_text(f"<!-- Written by `make calibration`; do not edit. -->\n\n{page}\n", encoding="utf-8")
    return 0


def table() -> list[str]:
    """Lines of Markdown: a row for each law that its time step can follow."""
    low, high, width = ContactLaw().solimp
    lines = [
        f"A ball at {SPEED:g} m/s, `solimp` [{low:g}, {high:g}, {width:g}]; *e* with the range that comes of where",
        "in a time step the contact begins; *ideal*: of the same spring and damper in continuous time.",
        "",
        "| time step | T | ζ | *e* | range | ideal | duration | depth | peak force |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for step in STEPS:
        for time in TIMES:
            # What is faster than the time steps is refused.
            for damping in (z for z in DAMPINGS if time >= 2 * step and time * z >= step * (1 - 1e-9)):
                b = measure_restitution(ContactLaw(solref=(time, damping)), speed=SPEED, timestep=step)
                lines.append(
                    f"| {step * 1e3:g} ms | {time * 1e3:g} ms | {damping:g} | {b.restitution:.3f} | {b.spread:.3f} "
                    f"| {ideal_restitution(damping):.3f} | {b.duration * 1e3:.1f} ms | {b.depth * 1e3:.2f} mm "
                    f"| {b.peak:.1f} |"
                )
    default = Physics().timestep
    fast, slow = (measure_restitution(ContactLaw(), speed=v, timestep=default) for v in (0.1, 1.0))
    heavy = measure_restitution(ContactLaw(), speed=SPEED, timestep=default, mass=100.0)
    lines += [
        "",
        "*Peak force*: over the mean force of the contact.",
        "",
        f"The default law (T = {ContactLaw().solref[0] * 1e3:g} ms, ζ = {ContactLaw().solref[1]:g}) has e = "
        f"{fast.restitution:.3f} at 0.1 m/s, {slow.restitution:.3f} at 1 m/s, and {heavy.restitution:.3f} at "
        f"{SPEED:g} m/s with a ball of 100 kg instead of 1 kg.",
    ]
    return lines


if __name__ == "__main__":
    sys.exit(main())
