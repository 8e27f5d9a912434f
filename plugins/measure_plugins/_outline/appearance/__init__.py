"""Forward model of a ball's picture: reflectance, lights, surroundings, and the sensor chain."""
