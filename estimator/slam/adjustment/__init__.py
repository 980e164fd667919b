"""Bundle adjustment of the map, and whether its result agrees with the odometry."""
