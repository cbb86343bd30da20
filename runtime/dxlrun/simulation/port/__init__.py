"""Port: how programs reach a simulated bus."""
