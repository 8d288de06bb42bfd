"""`python -m simulated_devices`: simulated devices on ptys and ports of this host, for any program to read.

Prints the rig to record them as one YAML document, ended by a line `...`, and runs until it is interrupted or the
process that started it ends.
"""

import argparse
import logging
import os
import signal
import sys
from pathlib import Path
from types import FrameType

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # before NumPy: a process per device is parallel enough

import cv2
import yaml

from recorder.errors import ConfigError, RecorderError
from simulated_devices.ideal import write_ideal
from simulated_devices.replay import replay
from simulated_devices.rig import read_rig, simulated_rig
from simulated_devices.simulation import DeviceDiedError

EXIT_FAILED = 1
EXIT_WRONG_USE = 2


def main(arguments: list[str] | None = None) -> int:
    """Run the simulated rig; give the exit code."""
    parent = os.getppid()
    parser = argparse.ArgumentParser(
        prog="python -m simulated_devices", epilog="example: python -m simulated_devices --set simulate.seed=3"
    )
    parser.add_argument("rig", nargs="?", type=Path, metavar="RIG.yaml", help="default: the built-in rig")
    parser.add_argument("--set", action="append", default=[], metavar="key=value", help="set a key path of the rig")
    parser.add_argument("--ideal", type=Path, metavar="DIR", help="write the same world straight to a recording")
    parser.add_argument("--duration", type=float, default=30.0, metavar="S", help="seconds of it (with --ideal)")
    parser.add_argument("--replay", type=Path, metavar="REC", help="bring the devices of a recording back instead")
    parser.add_argument("--speed", type=float, default=1.0, metavar="X", help="so many times as fast (with --replay)")
    parser.add_argument("--report", action="store_true", help="at the end, say what was sent and how timely")
    options = parser.parse_args(arguments)
    logging.basicConfig(stream=sys.stderr, level=logging.WARNING, format="%(message)s")
    cv2.setNumThreads(1)
    signal.signal(signal.SIGTERM, _interrupt)
    try:
        if options.ideal is not None:
            write_ideal(read_rig(options.rig, tuple(options.set)), options.ideal, options.duration)
            return 0
        if options.replay is not None:
            simulation = replay(options.replay, options.speed, report=options.report)
        else:
            simulation = simulated_rig(read_rig(options.rig, tuple(options.set)), report=options.report)
        with simulation:
            sys.stdout.write(yaml.safe_dump(simulation.document, sort_keys=False, explicit_end=True))
            sys.stdout.flush()
            simulation.run(parent)
        if options.replay is not None:
            sys.stderr.write("the replay is over\n")
    except KeyboardInterrupt:
        return 0
    except BrokenPipeError:  # whoever wanted to read the rig is gone
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except ConfigError as error:
        sys.stderr.write(f"{error}\n")
        return EXIT_WRONG_USE
    except (DeviceDiedError, RecorderError) as error:
        sys.stderr.write(f"{error}\n")
        return EXIT_FAILED
    return 0


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


if __name__ == "__main__":
    sys.exit(main())
