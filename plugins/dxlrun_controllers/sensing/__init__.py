"""Controllers that turn what devices and sensors measure into states, messages and decisions."""
