"""The report: one offline HTML page of a result or of runs, with the robot in 3-D, curves, tables and figures.

:func:`~impact_posture.report.result_report.result_scene` and :func:`~impact_posture.report.run_report.run_scene` say what
moves, :mod:`~impact_posture.report.page` writes the page, and ``viewer/`` holds what the page runs.
"""

REPORT = "report.html"
