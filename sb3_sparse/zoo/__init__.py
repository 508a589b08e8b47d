"""Training runs: settings that work, and what ``sb3-sparse train`` does with them."""
