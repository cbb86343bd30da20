"""Port: serial lines, opened, locked and opened again."""
