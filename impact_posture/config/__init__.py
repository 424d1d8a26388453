"""Settings, the checks of their values, and readers of files and arguments that contain settings."""
