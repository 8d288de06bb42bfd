"""Which protocol speaks: each capture and example is told from all others."""

from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.recognise import describe, recognise

DATA = Path(__file__).parent.parent / "data"
WIT = bytes.fromhex("5551000400FC00084E0C08 5552A400B8FE10004E0C6B 55547800D3FF36014E0C84")
RVC = bytes.fromhex("AAAADE010092FF25088DFEECFFD103000000E7")
LINES = b"1234567,0.10,-0.20,9.81,0.010,-0.020,0.030\r\n"
VN_LINE = (
    b"$VNIMU,-00.0350,+00.4222,-00.6643,-00.015,+00.019,+09.948,+00.002066,-00.008442,-00.044656,+20.7,+084.322*66\r\n"
)
SPEECH = {
    "xsens": (DATA / "xsens" / "1.bin").read_bytes()[7:3000],
    "vectornav": VN_LINE[20:] + VN_LINE * 20,
    "microstrain": (DATA / "mip" / "mip_data.bin").read_bytes()[5:4000],
    "witmotion": WIT[3:] + WIT * 20,
    "bno08x-rvc": RVC[4:] + RVC * 20,
    "nmea": (DATA / "nmea" / "nmea-rtk.log").read_bytes()[30:4000],
    "ascii-imu": LINES[4:] + LINES * 20 + LINES[:9],
}


@pytest.mark.parametrize("driver", SPEECH)
def test_recognised(driver: str) -> None:
    assert recognise(SPEECH[driver])[0][0] == driver


def test_more_captures() -> None:
    assert recognise((DATA / "vectornav" / "F00294").read_bytes()[:4096])[0][0] == "vectornav"
    assert recognise((DATA / "nmea" / "ublox-zed-f9p.mixed").read_bytes()[:8192])[0][0] == "nmea"


def test_evidence_is_told() -> None:
    assert describe(SPEECH["nmea"]).startswith("; it looks like NMEA sentences: ")
    assert describe(SPEECH["nmea"]).endswith("(driver nmea)")
    assert describe(b"") == ""


@pytest.mark.parametrize(
    "noise", [b"\0" * 5000, b"\xff\xfe\x80" * 2000, b"hello world\r\n" * 300, b"1" * 60000, b"0 " * 30000]
)
def test_noise_is_nothing(noise: bytes) -> None:
    assert recognise(noise) == []


@settings(max_examples=50, deadline=None)
@given(st.binary(max_size=4096))
def test_any_bytes(data: bytes) -> None:
    recognise(data)
