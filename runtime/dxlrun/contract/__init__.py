"""What a plug-in sees: controllers, sensors, the hooks; and the hardware that the loop drives."""
