"""Settings, the demands on their values, and the files and arguments that hold them."""
