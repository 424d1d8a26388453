"""Ranges of the random draws, and variations that change one value each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Range:
    """Range of a drawn value from low to high, with the scale ``linear``, ``log``, or ``sign`` (low or high)."""

    name: str
    low: float
    high: float
    words: str
    scale: str = "linear"

    def draw(self, rng: np.random.Generator) -> float:
        if self.scale == "sign":
            return self.low if rng.random() < 0.5 else self.high
        if self.scale == "log":
            return float(np.exp(rng.uniform(np.log(self.low), np.log(self.high))))
        return float(rng.uniform(self.low, self.high))

    def text(self) -> str:
        how = {"linear": "{} … {}", "log": "{} … {}, log-uniform", "sign": "{} or {}"}[self.scale]
        return how.format(f"{self.low:g}", f"{self.high:g}")


_COMMON = (
    Range("armature", 0.1, 3.0, "factor on the armature of every joint", "log"),
    Range("gain", 0.25, 4.0, "factor on K", "log"),
    Range("contact", 0.25, 4.0, "factor on the stiffness of the surface", "log"),
)
_TOOL = (
    Range("tilt", -5.0, 5.0, "angle between tool and normal in the plane of the arm, degrees"),
    Range("roll", -3.0, 3.0, "angle between tool and normal across that plane, degrees"),
)
_SLIP = Range("friction", 0.15, 0.6, "friction of the surface")


def _pushed(stir: float) -> tuple[Range, ...]:
    words = "size of the random changes of the joints at the start, rad; the feet stay in place"
    return (
        Range("stir", 0.02, stir, words),
        Range("force", 0.6, 1.4, "factor on the force of the push"),
        Range("stiffness", 0.5, 2.0, "factor on the gains of center of mass, base and posture", "log"),
        Range("friction", 0.5, 1.0, "friction of the ground"),
        *_COMMON,
    )


RANGES: dict[str, tuple[Range, ...]] = {
    "aerial-vertical": (
        Range("elbow", 0.4, 1.2, "bend of the elbow at the start, rad; the shoulder turns the tool to the floor"),
        Range("fold", -1.0, 1.0, "way in which the elbow bends at the start", "sign"),
        *_TOOL,
        Range("speed", 0.25, 0.6, "speed of approach, m/s"),
        Range("x", -0.04, 0.10, "distance of the shoulder's pitch axis ahead of the base's center, m"),
        Range("z", -0.10, -0.02, "height of the shoulder over the base's center, m"),
        _SLIP,
        *_COMMON,
    ),
    "aerial-lateral": (
        Range(
            "shoulder", -1.9, -0.6, "pitch of the shoulder at the start, rad; the elbow turns the tool to the wall"
        ),
        *_TOOL,
        Range("speed", 0.2, 0.45, "speed of approach, m/s"),
        Range("x", -0.04, 0.10, "distance of the shoulder's pitch axis ahead of the base's center, m"),
        Range("z", -0.10, 0.0, "height of the shoulder over the base's center, m"),
        _SLIP,
        *_COMMON,
    ),
    # The posture of a quadruped can change more than the posture of a humanoid.
    "solo8-push": _pushed(0.3),
    "talos-push": _pushed(0.15),
}
# Position of the shoulder's pitch axis in the URDF, m.
URDF_X, URDF_Z = 0.08, -0.06

SHIPPED = "as shipped"
_URDF = {"mounted as in the URDF": {"x": URDF_X}}
_GAIN = {"K × 0.5": {"gain": 0.5}, "K × 2": {"gain": 2.0}}
_ARMATURE = {"armature ÷ 3": {"armature": 1 / 3}, "armature × 3": {"armature": 3.0}}
_CONTACT = {"surface ÷ 4 as stiff": {"contact": 0.25}, "surface × 4 as stiff": {"contact": 4.0}}
_AERIAL_SLIP = {"μ 0.15": {"friction": 0.15}, "μ 0.6": {"friction": 0.6}}
_PUSHED = {
    SHIPPED: {},
    **_GAIN,
    "start stirred, first": {"stir": 0.15},
    **_ARMATURE,
    "push × 0.5": {"force": 0.5},
    "push × 1.5": {"force": 1.5},
    "start stirred, second": {"stir": 0.15},
    "μ 0.5": {"friction": 0.5},
    "μ 1.2": {"friction": 1.2},
    **_CONTACT,
    "start stirred, third": {"stir": 0.15},
    "gains × 0.5": {"stiffness": 0.5},
    "gains × 2": {"stiffness": 2.0},
}
# Each variation changes one value; all other values are as shipped.  The most important variations come first.
VARIATIONS: dict[str, dict[str, dict[str, float]]] = {
    "aerial-vertical": {
        SHIPPED: {},
        **_GAIN,
        "elbow 0.5": {"elbow": 0.5},
        "elbow 1.3": {"elbow": 1.3},
        **_ARMATURE,
        **_URDF,
        "speed × 0.5": {"speed": 0.25},
        "speed × 1.5": {"speed": 0.75},
        "elbow 0.7": {"elbow": 0.7},
        "elbow −0.9": {"elbow": 0.9, "fold": -1.0},
        "mounted 4 cm back": {"x": -0.04},
        "mounted 4 cm ahead": {"x": 0.04},
        **_CONTACT,
        **_AERIAL_SLIP,
    },
    "aerial-lateral": {
        SHIPPED: {},
        **_GAIN,
        "shoulder −0.75": {"shoulder": -0.75},
        "shoulder −1.4": {"shoulder": -1.4},
        **_ARMATURE,
        **_URDF,
        "speed × 0.5": {"speed": 0.15},
        "speed × 1.5": {"speed": 0.45},
        "speed × 1.67 (as vertical)": {"speed": 0.5},
        "shoulder −1.7": {"shoulder": -1.7},
        "mounted 3 cm higher": {"z": -0.03},
        "mounted 3 cm lower": {"z": -0.09},
        **_CONTACT,
        **_AERIAL_SLIP,
    },
    "solo8-push": _PUSHED,
    "talos-push": _PUSHED,
}
