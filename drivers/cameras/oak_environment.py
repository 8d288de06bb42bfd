"""Imports depthai so that it keeps quiet and leaves Ctrl-C to the recorder."""

import os

os.environ.setdefault("DEPTHAI_INSTALL_SIGNAL_HANDLER", "0")  # else it ends the process while files are being closed
os.environ.setdefault("DEPTHAI_LEVEL", "error")  # it would print into the status

import depthai as dai

__all__ = ["dai"]
