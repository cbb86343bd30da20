"""Devices: what is on a servo bus and is not a servo, with states, commands and safe values."""
