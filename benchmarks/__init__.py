"""Measurements of accuracy and speed; run each as ``python -m benchmarks.NAME``."""
