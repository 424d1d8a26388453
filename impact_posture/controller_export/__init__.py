"""The online controller as C: one library without an interpreter, with the answers of ``impact_posture.tsid``."""
