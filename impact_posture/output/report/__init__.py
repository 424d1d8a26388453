"""The report: an offline HTML page for a result or for runs, with a 3-D view of the robot, curves and tables.

:mod:`~impact_posture.output.report.result_report` and :mod:`~impact_posture.experiment.run_reports` collect the
content, and :mod:`~impact_posture.output.report.report_page` writes the page.  ``viewer/`` contains its scripts.
"""

REPORT = "report.html"
