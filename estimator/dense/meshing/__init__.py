"""Meshes of a scene: signed distances of depth maps, the triangles of their zero level, and a texture."""

__all__: list[str] = []
