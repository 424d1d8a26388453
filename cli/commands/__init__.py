"""Subcommands of ``impact-posture``, one file each: read options, call the library, print the result.

A new subcommand is a file here with a function of the same name, and a row of :data:`COMMANDS`.  It imports the
library when it runs.
"""

from __future__ import annotations

from typing import Final

COMMANDS: Final[dict[str, str]] = {
    "robots": "List the robots known by name, and how else to name one.",
    "inspect": "Show a robot: joints, frames, mass, limits, armature, postures, actuation.",
    "evaluate": "Measure an impact at a posture: H, G, V, S, E, ellipsoid, gradient, predicted jump.",
    "optimize": "Find the posture that takes the impact best; write posture, pictures and C code.",
    "plot": "Draw a result again: ellipsoids, postures, jumps, the null-space path.",
    "report": "Write report.html of an output folder again: one offline page, with the robot in 3-D.",
    "view": "Open report.html of an output folder in the browser.",
    "codegen": "Write the metric and its gradient as C code for a controller.",
    "verify": "Compute H, G, Λ_c and ∇H in every way there is and compare: pass or fail.",
    "simulate": "Run a controller through an experiment in MuJoCo; write metrics, time series and figures.",
    "compare": "Run several controllers through an experiment, several seeds each: means with 95 % intervals.",
    "reproduce": (
        "Run the paper's experiments: its table beside ours, figures, a summary. Goes on where it was interrupted."
    ),
    "sweep": "Solve a grid of problems on whatever machines there are; 'sweep show DIR' draws maps of the results.",
}
"""Name and help text of each subcommand, in the order of the help page."""
