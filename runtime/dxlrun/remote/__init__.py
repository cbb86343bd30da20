"""Steering from outside: the gateway's process beside a run, and the client that talks to it."""
