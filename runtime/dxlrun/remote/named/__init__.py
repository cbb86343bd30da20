"""What clients name: joints, their registers, commands of joints and devices, a controller's parameters."""
