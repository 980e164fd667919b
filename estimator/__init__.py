"""Turns what was sensed into motion and a map: GTSAM lives here, and only here."""
