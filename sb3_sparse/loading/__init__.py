"""Read saved files; every error names the file that cannot be read."""
