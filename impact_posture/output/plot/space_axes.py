"""3-D axes with equal scales, whose tick numbers and axis names do not overlap."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.mplot3d import Axes3D

from impact_posture.output.plot.style import SMALL, TINY, text_width
from impact_posture.system.arrays import Array

# Ticks are left out within this share of the axis length at both ends, where two axes meet.
_CORNER = 0.07


class Space(Axes3D):  # type: ignore[misc]
    """3-D axes whose layout has space for the axis names."""

    def get_tightbbox(self, renderer: Any = None, **more: Any) -> Any:
        """Return the box around the axes with their names, which Matplotlib would ignore in a layout."""
        return super().get_tightbbox(renderer, **(more | {"for_layout_only": False}))


def frame_space(axes: Any, low: Array, high: Array, unit: str, bins: int, *, azimuth: float) -> None:
    """Give 3-D axes the limits ``low`` to ``high``, shape (3,), equal scales, few ticks, and names with the unit."""
    size = high - low
    axes.set_box_aspect(tuple(size))
    axes.view_init(elev=21, azim=azimuth)
    for k, name in enumerate("xyz"):
        getattr(axes, f"set_{name}lim")(low[k], high[k])
        axis = getattr(axes, f"{name}axis")
        share = float(size[k] / size.max())
        longest = _set_ticks(axis, low[k], high[k], round(bins * share), room=np.inf if name == "z" else 95 * share)
        # In a cube, matplotlib centers numbers 8 points and names 21 points from their axis.  In a flat box, numbers
        # and names are nearer.
        scale = max(float(np.delete(size, k).mean() / size.max()), 0.25)
        axes.tick_params(axis=name, pad=(8 if name == "z" else 6) / scale - 8, labelsize=TINY)
        getattr(axes, f"set_{name}label")(f"{name}  [{unit}]", labelpad=(longest / 2 + 4) / scale - 13, size=SMALL)


def _set_ticks(axis: Any, low: float, high: float, bins: int, room: float) -> float:
    """Set few ticks, so that their numbers fit into ``room`` (points); return the width of the longest number."""
    air = _CORNER * (high - low)
    for count in range(max(bins, 3), 0, -1):
        ticks = np.asarray(MaxNLocator(count, steps=[1, 2, 2.5, 5, 10]).tick_values(low, high))
        ticks = ticks[(low + air <= ticks) & (ticks <= high - air)]
        axis.set_ticks(ticks)
        longest = max((text_width(t, TINY) for t in axis.get_major_formatter().format_ticks(ticks)), default=0.0)
        if len(ticks) * longest <= room or len(ticks) < 2:
            break
    return longest
