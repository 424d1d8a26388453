"""Run the command line by ``python -m impact_posture``."""

from impact_posture_cli.main import main

main()
