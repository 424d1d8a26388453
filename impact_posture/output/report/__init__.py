"""The report: one offline HTML page of a result or of runs, with the robot in 3-D, curves, tables and figures.

:mod:`~impact_posture.output.report.result_report` and :mod:`~impact_posture.experiment.run_reports` say what moves,
:mod:`~impact_posture.output.report.report_page` writes the page, and ``viewer/`` holds what the page runs.
"""

REPORT = "report.html"
