"""Camera models and extrinsics: calibration.json and its checks."""
