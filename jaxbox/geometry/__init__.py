"""Plane geometry, projection into a camera's image, and how a sensor is mounted."""
