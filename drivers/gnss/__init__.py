"""GNSS receivers."""
