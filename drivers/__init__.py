"""Device drivers: links, decoders, and the care of devices."""
