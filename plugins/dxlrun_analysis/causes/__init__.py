"""Causes of late and long cycles, derived from the packets and the plan alone.

Pairing packets with servos belongs in `servos`, on which this package builds. Verdicts belong in
`verdict.py`.
"""
