"""Lens models: the mapping from directions in the camera frame to the image plane."""

__all__: list[str] = []
