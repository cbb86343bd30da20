"""Output: a report as tables for the terminal, and as one HTML file."""
