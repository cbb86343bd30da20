"""Description: robot files and motion files, their form only; validated, frozen, with line and column."""
