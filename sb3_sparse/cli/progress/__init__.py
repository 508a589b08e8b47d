"""What a user sees while a command works: bars on a terminal, lines elsewhere."""
