"""Why cycles were late or too long, from the packets and the plan alone; above `servos`, which pairs them."""
