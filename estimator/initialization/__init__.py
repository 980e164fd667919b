"""Initialization: gravity, velocity and biases from a static interval or from motion."""
