"""``python -m impact_posture``, the same program as ``impact-posture``."""

from impact_posture_cli.main import main

if __name__ == "__main__":
    main()
