"""Can jaxbox be relied on? Fuzzing, faults, load and mutants; run each as ``python -m quality.NAME``."""
