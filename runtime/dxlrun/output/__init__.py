"""Output: tables and lines as data, and what renders them for terminals, programs and HTML pages."""
