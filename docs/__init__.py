"""The documentation, a package so that tests import the studies as ``docs.studies``."""
