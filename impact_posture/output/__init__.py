"""The result folder: files, figures and the report."""
