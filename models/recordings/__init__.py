"""Recordings of flights, and trajectories, as files: what other programs wrote and what they will read."""
