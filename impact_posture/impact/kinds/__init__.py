"""The objective types ``impulse``, ``speed``, ``sticking``, ``coulomb`` and ``energy``, one class each."""
