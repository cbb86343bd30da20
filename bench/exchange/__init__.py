"""The exchange with the servos, ours and that of other programs, measured side by side."""
