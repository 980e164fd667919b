"""Where to fly: shapes, minimum-snap paths within limits, clear of what stands in the way; and recorded paths."""
