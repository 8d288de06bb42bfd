"""The simulated rig as a process of its own, which the recorder knows only by the rig.yaml it prints."""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

from recorder.errors import ConfigError, RecorderError

END_OF_YAML = "..."
STOP_TIMEOUT_S = 5.0
EXIT_WRONG_USE = 2


def command(rig: Path | None, settings: tuple[str, ...]) -> list[str]:
    """The command line that runs the simulated rig."""
    arguments = [sys.executable, "-m", "simulated_devices"]
    if rig is not None:
        arguments.append(str(rig))
    for setting in settings:
        arguments += ["--set", setting]
    return arguments


class SimulatedRig:
    """Runs simulated devices until it is closed; `yaml` is the rig to record them."""

    def __init__(self, rig: Path | None, settings: tuple[str, ...]) -> None:
        """Start and wait until it is ready. Raises ConfigError for wrong settings, RecorderError if it fails."""
        # A session of its own: Ctrl-C on the terminal must stop the recorder first, the devices after it.
        self._messages = tempfile.TemporaryFile("w+")  # noqa: SIM115 - a pipe that nobody reads would block it
        self._process = subprocess.Popen(
            command(rig, settings),
            stdout=subprocess.PIPE,
            stderr=self._messages,
            text=True,
            start_new_session=True,
            env=os.environ | {"PYTHONUNBUFFERED": "1"},
        )
        assert self._process.stdout is not None
        lines: list[str] = []
        for line in self._process.stdout:
            if line.rstrip() == END_OF_YAML:
                self.yaml = "".join(lines)
                return
            lines.append(line)
        exit_code = self._process.wait()
        self._messages.seek(0)
        message = self._messages.read().strip() or "the simulated rig ended without a word"
        self.close()
        if exit_code == EXIT_WRONG_USE:
            raise ConfigError(message)
        raise RecorderError(f"the simulated rig failed: {message}")

    def close(self) -> None:
        """Stop the devices."""
        self._process.terminate()
        try:
            self._process.communicate(timeout=STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.communicate()
        self._messages.close()
