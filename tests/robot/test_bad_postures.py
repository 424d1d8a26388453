"""Invalid postures, contacts and weights: each error is one line with the fault, the place and a hint."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from impact_posture.errors import InputError, MetricError, NotWithinLimits, PostureError
from impact_posture.impact.impact_contact import ImpactContact
from impact_posture.impact.metric import build_metric
from tests.robot.test_bad_models import one_line
from tests.support.helpers import robot

# ---- postures -----------------------------------------------------------------------------------------------------


def test_wrong_length_and_not_finite() -> None:
    loaded = robot("solo8")
    for q in ([], [0.0] * 14, [0.0] * 16):
        with pytest.raises(PostureError) as caught:
            loaded.check_posture(np.array(q))
        one_line(caught.value, "has 15 numbers", f"this one {len(q)}", "qx, qy, qz, qw")
    for value in (np.nan, np.inf, -np.inf):
        for k in (0, 3, 9):
            q = loaded.posture()
            q[k] = value
            with pytest.raises(PostureError) as caught:
                loaded.check_posture(q, where="--posture p.json")
            one_line(caught.value, f"entry {k} is not finite", "--posture p.json")


@pytest.mark.parametrize("scale", [0.0, 0.5, 0.99, 1.01, 100.0])
def test_quaternion_of_wrong_norm(scale: float) -> None:
    q = robot("talos").posture()
    q[3:7] *= scale
    with pytest.raises(PostureError) as caught:
        robot("talos").check_posture(q)
    one_line(caught.value, "base quaternion has norm", "x y z w")


def test_a_rounded_quaternion_is_normalized() -> None:
    q = robot("talos").posture()
    q[3:7] = [0.1826, 0.3651, 0.5477, 0.7303]
    checked = robot("talos").check_posture(q)
    assert np.linalg.norm(checked[3:7]) == pytest.approx(1.0, abs=1e-15)
    np.testing.assert_allclose(checked[3:7], q[3:7], atol=1e-4)


def test_cosine_and_sine_of_a_continuous_joint() -> None:
    q = robot("kinova").posture()
    q[:2] = 0.9, 0.9
    with pytest.raises(PostureError) as caught:
        robot("kinova").check_posture(q)
    one_line(caught.value, "cosine and sine", "j2s6s200_joint_1")


@pytest.mark.parametrize("name", ["solo8", "tilthex_arm"])
@pytest.mark.parametrize("wxyz", [(1.0, 0.0, 0.0, 0.0), (-1.0, 0.0, 0.0, 0.0), (0.9996, 0.02, 0.0, 0.02)])
def test_the_identity_with_its_scalar_first_is_detected(name: str, wxyz: tuple[float, ...]) -> None:
    loaded = robot(name)
    q = loaded.posture()
    q[3:7] = wxyz
    with pytest.raises(PostureError) as caught:
        loaded.check_posture(q)
    one_line(caught.value, "looks like w x y z", "scalar last")


def test_a_small_tilt_with_its_scalar_first_is_detected() -> None:
    loaded = robot("solo8")
    q = loaded.posture()
    q[3:7] = np.array([0.98, 0.1, -0.1, 0.05]) / np.linalg.norm([0.98, 0.1, -0.1, 0.05])
    with pytest.raises(PostureError, match="w x y z"):
        loaded.check_posture(q)
    q[3:7] = q[[4, 5, 6, 3]]
    loaded.check_posture(q)


@pytest.mark.parametrize(
    "xyzw",
    [
        (0, 0, 0, 1), (0, 0, 0, -1), (0, 0, 1, 0), (0, 1, 0, 0), (0, 0, 0.6, 0.8), (0.6, 0, 0, 0.8), (0, 0.6, 0, 0.8),
        (0.8, 0, 0, 0.6), (0.5, 0.5, 0.5, 0.5), (0, 0.8, 0.6, 0),
    ],
)  # fmt: skip
@pytest.mark.parametrize("name", ["solo8", "tilthex_arm"])
def test_legitimate_attitudes_pass(name: str, xyzw: tuple[float, ...]) -> None:
    loaded = robot(name)
    q = loaded.posture()
    q[3:7] = xyzw
    np.testing.assert_allclose(loaded.check_posture(q)[3:7], xyzw, atol=1e-15)


def test_a_fixed_robot_has_no_quaternion_to_swap() -> None:
    loaded = robot("ur5")
    q = np.array([0.1, -0.2, 0.3, 1.0, 0.0, 0.0])
    np.testing.assert_array_equal(loaded.check_posture(q), q)


def test_posture_outside_the_limits() -> None:
    loaded = robot("panda")
    q = loaded.posture()
    k = int(loaded.model.idx_qs[loaded.joint_id("panda_joint4")])
    q[k] = 0.5
    with pytest.raises(NotWithinLimits) as caught:
        loaded.check_posture(q)
    assert (caught.value.joint, caught.value.value) == ("panda_joint4", 0.5)
    assert caught.value.upper == loaded.model.upperPositionLimit[k]
    one_line(caught.value, "panda_joint4", "0.5", "limits")
    np.testing.assert_array_equal(loaded.check_posture(q, limits=False), q)
    # A value may exceed the limit by a rounding error.
    q[k] = loaded.model.upperPositionLimit[k] + 1e-9
    loaded.check_posture(q)


# ---- contacts and weights -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("normal", [(0, 0, 0), (0, 0, 1e-12), (np.nan, 0, 1), (np.inf, 0, 0), (0, 1)])
def test_normals_without_direction(normal: tuple[float, ...]) -> None:
    with pytest.raises(InputError) as caught:
        ImpactContact("ee", normal)  # type: ignore[arg-type]
    one_line(caught.value, "not all zero", "normal")


def test_normals_are_normalized() -> None:
    assert np.linalg.norm(ImpactContact("ee", (3, -4, 12)).normal) == pytest.approx(1.0, abs=1e-15)
    assert ImpactContact("ee", (0, 0, 1e-6)).normal == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("impulse", [0.0, -1.0, np.nan, np.inf])
def test_impossible_impulses_and_offsets(impulse: float) -> None:
    with pytest.raises(InputError) as caught:
        ImpactContact("ee", (0, 0, 1), impulse=impulse)
    one_line(caught.value, "impulse: ")
    with pytest.raises(InputError) as caught:
        ImpactContact("ee", (0, 0, 1), offset=(0.0, np.nan, 0.0))
    one_line(caught.value, "offset: ")


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("panda_joint1 = 0.0", ("panda_joint1", "is 0", "above zero")),
        ("panda_joint1 = -2.0", ("panda_joint1", "is -2")),
        ("panda_joint1 = nan", ("panda_joint1", "is nan")),
        ('panda_joint1 = "much"', ("panda_joint1", "not a number")),
    ],
)
def test_bad_weights(tmp_path: Path, text: str, words: tuple[str, ...]) -> None:
    path = tmp_path / "weights.toml"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(MetricError) as caught:
        build_metric(robot("panda"), "weighted", str(path))
    one_line(caught.value, *words)


def test_weights_that_do_not_fit_the_metric(tmp_path: Path) -> None:
    with pytest.raises(MetricError) as caught:
        build_metric(robot("panda"), "weighted")
    one_line(caught.value, "needs weights")
    with pytest.raises(MetricError) as caught:
        build_metric(robot("panda"), "kinetic", "velocity-limits")
    one_line(caught.value, "`metric` weighted")
    path = tmp_path / "weights.toml"
    path.write_text("panda_joint1 = 4.0\n", encoding="utf-8")
    metric = build_metric(robot("panda"), "weighted", str(path))
    np.testing.assert_array_equal(metric.diagonal(9), [4.0, *[1.0] * 8])
    path.write_text("base = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0]\nFL_KFE = 9.0\n", encoding="utf-8")
    metric = build_metric(robot("solo8"), "weighted", str(path))
    np.testing.assert_array_equal(metric.diagonal(14), [1, 2, 3, 4, 5, 6, 1, 9, *[1] * 6])
    path.write_text("base = [1.0, 2.0]\n", encoding="utf-8")
    with pytest.raises(MetricError) as caught:
        build_metric(robot("solo8"), "weighted", str(path))
    one_line(caught.value, "base")
