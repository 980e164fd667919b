"""Scores estimates, and shows them: metrics, reports, rerun recordings."""
