"""Control: the loop and what it calls in each cycle: steering, controllers, gate, policies."""
