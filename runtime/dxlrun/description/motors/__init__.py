"""Motor files: the model of a servo's motor, and the file that has its figures."""
