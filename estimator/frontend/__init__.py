"""The visual front end: features detected, tracked and matched across the cameras of a rig."""
