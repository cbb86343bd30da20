"""Experiments: measure the machine, the loop and the servos; one package an experiment."""
