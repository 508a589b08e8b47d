"""Reading what was saved: every file is named in the error when it cannot be read."""
