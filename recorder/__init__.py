"""The recorder: live devices in, a recording out."""
