"""Output: tables and lines for terminals and programs."""
