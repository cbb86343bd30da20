"""How records of a run become messages of a log, field by field."""
