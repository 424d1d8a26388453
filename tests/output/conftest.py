"""Fixtures for the tests of the figures."""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Iterator

import numpy as np
import pytest

from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.output.plot import ResultView
from tests.output.views import PENDULUM, make_view


@pytest.fixture(autouse=True)
def _no_warnings(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """Fail if Matplotlib issues a warning or writes to its log."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        yield
    assert not [r.getMessage() for r in caplog.records if r.name.startswith("matplotlib")]


@pytest.fixture(scope="module")
def tilthex() -> ResultView:
    return make_view("tilthex_arm", (0, 0, 1), speed=0.5, restitution=0.2)


@pytest.fixture(scope="module")
def surface(tilthex: ResultView) -> ResultView:
    """Return a result whose self-motion map has two dimensions."""
    assert tilthex.self_motion is not None
    return dataclasses.replace(tilthex, self_motion=dataclasses.replace(tilthex.self_motion, s=np.zeros(24)))


@pytest.fixture(scope="module")
def talos() -> ResultView:
    return make_view("talos", (-1, 0, 0), path=False)


@pytest.fixture(scope="module")
def two_hands(talos: ResultView) -> ResultView:
    """Return a result with impacts at both hands, along two normals."""
    other = ImpactContact("gripper_left_base_link", (0, -1, 0))
    return dataclasses.replace(talos, objective=dataclasses.replace(talos.objective, others=(other,)))


@pytest.fixture(scope="module")
def solo8() -> ResultView:
    return make_view("solo8", (1, 0, 0), path=False)


@pytest.fixture(scope="module")
def solo8_cone(solo8: ResultView) -> ResultView:
    """Return solo8 in its initial posture, where the mirror image of the worst normal is equally bad."""
    objective = dataclasses.replace(solo8.objective, normal_cone_deg=20.0)
    return dataclasses.replace(solo8, objective=objective, q_optimal=solo8.q_initial)


@pytest.fixture(scope="module")
def torso() -> ResultView:
    """Return a result whose numbers have many digits, so that its legends are widest."""
    view = make_view("talos", (1, 0, 0), "torso_2_link", path=False)
    return dataclasses.replace(view, objective=dataclasses.replace(view.objective, normal_cone_deg=12.5))


@pytest.fixture(scope="module")
def turned() -> ResultView:
    """Return a result whose cone of normals turns with the contact frame."""
    view = make_view("ur5", (0.3, 0.4, 1), normal_frame="contact", path=False)
    return dataclasses.replace(view, objective=dataclasses.replace(view.objective, normal_cone_deg=30.0))


@pytest.fixture(scope="module")
def panda() -> ResultView:
    return make_view("panda", (0, 0, 1), path=False)


@pytest.fixture(scope="module")
def pendulum() -> ResultView:
    return make_view(PENDULUM, (0, 1, 0), q0=np.array([0.4, 0.9]))
