"""Data types that all packages share: states, measurements, calibration, vehicles, and protocols.

The types are frozen dataclasses of numpy arrays. This package neither simulates, estimates nor evaluates.
"""
