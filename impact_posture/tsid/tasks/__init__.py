"""Tasks whose accelerations the controller regulates."""
