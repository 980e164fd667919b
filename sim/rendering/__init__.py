"""A recording's frames, drawn by several processes."""
