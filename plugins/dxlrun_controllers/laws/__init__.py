"""Laws: what controllers compute, on arrays of joints, without a robot."""
