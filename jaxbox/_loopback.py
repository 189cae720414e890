"""Addresses of this machine that no other machine reaches: what is served is served there unless asked."""

LOOPBACK = "127.0.0.1"
"""Where servers listen by default."""
LOOPBACK_NAMES = ("localhost", LOOPBACK, "::1")
"""Names by which programs of a machine reach it, also through a forwarded port."""
