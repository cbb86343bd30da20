"""Live data of a running robot: states of its newest cycle, and streams of messages.

Requests with a single reply belong in `requests`.
"""
