"""The figures of a report; each module draws one subject from a log."""
