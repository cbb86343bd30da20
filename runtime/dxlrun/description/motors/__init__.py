"""Motors, servos and mechanics: what moves a joint, by a file of its own or by the robot file."""
