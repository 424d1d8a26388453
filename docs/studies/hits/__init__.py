"""Recorded hits of a KUKA LBR iiwa 7 against boxes, compared with predictions."""
