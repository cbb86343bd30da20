"""Measuring the exchange with the servos, ours and others', and the rates that a robot keeps."""
