"""The kernel's speed on this machine, beside what a user would take instead of it."""
