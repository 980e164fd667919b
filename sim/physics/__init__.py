"""Dynamics of the quadrotor: rotors, aerodynamics, wind, contacts, and the controller."""

__all__: list[str] = []
