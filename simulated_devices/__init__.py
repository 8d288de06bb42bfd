"""Simulated devices that speak the real wire protocols; never imported by the recorder or the drivers."""
