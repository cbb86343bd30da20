"""What the robot did, and what clients asked of it."""
