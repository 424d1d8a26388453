"""Coefficient of restitution of each contact law, measured in the simulated world."""

from __future__ import annotations

from collections.abc import Iterator

from docs.studies.core import Request, table
from impact_posture.simulation.world.contact_law import ContactLaw
from impact_posture.simulation.world.scene import Physics
from impact_posture.system.optional_package import import_mujoco
from tests.support.restitution import ideal_restitution, measure_restitution

TIMES = (0.002, 0.005, 0.01, 0.02)
DAMPINGS = (0.1, 0.3, 0.5, 0.7, 1.0, 2.0)
STEPS = (2.5e-4, 1e-3)
SPEED = 0.5
_HEAD = "time step|T|ζ|*e*|range|ideal|duration|depth|peak force".split("|")


def lines(request: Request) -> Iterator[str]:
    """Yield a row for each contact law that is slow enough for its time step."""
    import_mujoco()
    low, high, width = ContactLaw().solimp
    yield (
        f"A ball at {SPEED:g} m/s, `solimp` [{low:g}, {high:g}, {width:g}]. The range of *e* depends on "
        "where in a time "
        "step\nthe contact begins. *Ideal*: the same spring and damper in continuous time."
    )
    yield ""
    # Leave out laws that are too fast for the time step, because the simulated world raises an error for them.
    laws = ((s, t, z) for s in STEPS for t in TIMES for z in DAMPINGS if t >= 2 * s and t * z >= s * (1 - 1e-9))
    yield from table(_HEAD, (_row(*law) for law in laws))
    default = Physics().timestep
    fast, slow = (measure_restitution(ContactLaw(), speed=v, timestep=default) for v in (0.1, 1.0))
    heavy = measure_restitution(ContactLaw(), speed=SPEED, timestep=default, mass=100.0)
    yield from ("", "*Peak force*: largest force over the mean force of the contact.", "")
    yield (
        f"The default law (T = {ContactLaw().solref[0] * 1e3:g} ms, ζ = {ContactLaw().solref[1]:g}) has e = "
        f"{fast.restitution:.3f} at 0.1 m/s, {slow.restitution:.3f} at 1 m/s, and {heavy.restitution:.3f} at "
        f"{SPEED:g} m/s with a ball of 100 kg instead of 1 kg."
    )


def _row(step: float, time: float, damping: float) -> list[str]:
    b = measure_restitution(ContactLaw((time, damping)), speed=SPEED, timestep=step)
    bounce = [f"{b.restitution:.3f}", f"{b.spread:.3f}", f"{ideal_restitution(damping):.3f}"]
    rest = [f"{b.duration * 1e3:.1f} ms", f"{b.depth * 1e3:.2f} mm", f"{b.peak:.1f}"]
    return [f"{step * 1e3:g} ms", f"{time * 1e3:g} ms", f"{damping:g}", *bounce, *rest]
