"""Gymnasium environments, plain: ``import dronevio.envs`` gives them their names."""
