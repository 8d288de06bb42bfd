"""The recording folder on disk: writers, readers and checks."""
