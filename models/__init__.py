"""What the drone, its sensors and their data are: plain frozen dataclasses of numpy arrays, and protocols.

Nothing here simulates, estimates or scores; every other room speaks in these types.
"""
