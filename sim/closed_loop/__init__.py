"""Flights on the estimated state: a control loop that is closed over an estimator."""

__all__: list[str] = []
