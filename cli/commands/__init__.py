"""Subcommands of ``impact-posture``.  Each file reads options, calls the library, and prints the result.

For a new subcommand, add a file with a function of the same name, and a row in :data:`COMMANDS`.  Import the library
inside this function, so that ``--help`` stays fast.
"""

from __future__ import annotations

from typing import Final

COMMANDS: Final[dict[str, str]] = {
    "robots": "List the robots known by name, and other ways to specify a robot.",
    "inspect": "Show a robot: joints, frames, mass, limits, armature, postures, actuation.",
    "evaluate": "Measure an impact at a posture: H, G, V, S, E, ellipsoid, gradient, predicted jump.",
    "optimize": "Find the posture with the smallest objective; write the posture, pictures and C code.",
    "plot": "Draw a result again: ellipsoids, postures, jumps, the null-space path.",
    "report": "Write report.html of an output folder again: an offline page with the robot in 3-D.",
    "view": "Open report.html of an output folder in the browser.",
    "codegen": "Write the metric and the gradient of the metric as C code for a controller.",
    "verify": "Compute H, G, Λ_c and ∇H with several methods and compare the results: pass or fail.",
    "simulate": "Run a controller through an experiment in MuJoCo; write metrics, time series and figures.",
    "compare": "Run several controllers through an experiment with several seeds: means with 95 % intervals.",
    "reproduce": (
        "Run the paper's experiments and compare the results with the paper. An interrupted run can be continued."
    ),
    "sweep": "Solve a grid of problems on one or many machines; 'sweep show DIR' draws maps of the results.",
}
"""Name and help text of each subcommand, in the order of the help page."""
