"""One thin file a command: options in, library call, output out.

A new command is a file here and a line in ``COMMANDS``.  Nothing heavy is imported before a command runs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from impact_posture_cli.commands.codegen import codegen
from impact_posture_cli.commands.compare import compare
from impact_posture_cli.commands.evaluate import evaluate
from impact_posture_cli.commands.inspect import inspect
from impact_posture_cli.commands.optimize import optimize
from impact_posture_cli.commands.plot import plot
from impact_posture_cli.commands.reproduce import reproduce
from impact_posture_cli.commands.robots import robots
from impact_posture_cli.commands.simulate import simulate
from impact_posture_cli.commands.verify import verify

COMMANDS: Final[dict[str, Callable[..., None]]] = {
    "robots": robots,
    "inspect": inspect,
    "evaluate": evaluate,
    "optimize": optimize,
    "plot": plot,
    "codegen": codegen,
    "verify": verify,
    "simulate": simulate,
    "compare": compare,
    "reproduce": reproduce,
}
"""Name to function, in the order of the help page."""
