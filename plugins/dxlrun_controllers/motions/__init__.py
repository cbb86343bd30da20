"""Controllers that play motions."""
