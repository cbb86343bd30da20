"""Tools: scan a port, change one servo, back it up."""
