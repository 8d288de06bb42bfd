"""`rigtape calibrate`: calibration.json from boards, other programs' files and device memory."""

import click


@click.group()
def calibrate() -> None:
    """Make a calibration.json: print a board, record it, calibrate; or import one from elsewhere.

    \b
    Examples:
      rigtape calibrate board --paper A4 -o board.pdf
      rigtape calibrate cameras demo/board -o calibration.json
      rigtape calibrate import camchain-imucam.yaml --format kalibr -o calibration.json
    """
