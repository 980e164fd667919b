"""Appearance of worlds: surfaces, textures and light maps, and their conversion to MuJoCo meshes."""

__all__: list[str] = []
