"""Time: where the sensor was at each sweep, and vehicles over the sweeps of a recording."""
