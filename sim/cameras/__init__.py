"""From a world to what a lens and a sensor make of it."""
