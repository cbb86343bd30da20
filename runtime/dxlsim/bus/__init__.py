"""Bus: one simulated line and its adapter, what passes on it and when, and its ledger."""
