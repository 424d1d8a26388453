"""Tasks of the controller."""
