import math
from functools import reduce

import pytest
from hypothesis import given
from hypothesis import strategies as st

from simulated_devices.nmea import Fix, degrees_minutes, epoch_sentences, sentence

# 2026-03-01 23:59:59.9 UTC
FIX = Fix(1_772_409_599_900_000_000, 60.1738, 24.9065, 14.19, 17.8, (0.3, 0.4), (0.010, 0.012, 0.020))


def test_a_sentence_of_the_textbooks():
    body = "GPGGA,123519,4807.038,N,01131.000,E,1,08,0.9,545.4,M,46.9,M,,"
    assert sentence(body) == b"$" + body.encode() + b"*47\r\n"


def test_the_sentences_of_an_epoch():
    assert epoch_sentences(FIX) == [
        b"$GNGGA,235959.90,6010.42800000,N,02454.39000000,E,4,24,0.6,14.1900,M,17.8000,M,1.0,0001*66\r\n",
        b"$GNRMC,235959.90,A,6010.42800000,N,02454.39000000,E,0.972,36.87,010326,,,R,V*25\r\n",
        b"$GNGST,235959.90,0.0120,0.0120,0.0100,90.0,0.0100,0.0120,0.0200*79\r\n",
        b"$GNZDA,235959.90,01,03,2026,00,00*74\r\n",
    ]


def test_south_and_west():
    fix = Fix(FIX.utc_ns, -33.5, -70.25, 500.0, -20.0, (0.0, 0.0), (0.01, 0.01, 0.02))
    gga, rmc, _, _ = (line.decode().split(",") for line in epoch_sentences(fix))
    assert gga[2:6] == ["3330.00000000", "S", "07015.00000000", "W"]
    assert gga[11] == "-20.0000"
    assert rmc[3:7] == gga[2:6]


@pytest.mark.parametrize(
    ("angle_deg", "text"),
    [(0.0, "0000.00000000"), (8 + 59.999999999 / 60, "0900.00000000"), (59.5, "5930.00000000")],
)
def test_minutes_never_reach_sixty(angle_deg, text):
    assert degrees_minutes(angle_deg, 2) == text


@given(st.floats(-180, 180))
def test_an_angle_keeps_its_value_to_a_tenth_of_a_millimetre(angle_deg):
    text = degrees_minutes(angle_deg, 3)
    assert math.isclose(int(text[:3]) + float(text[3:]) / 60, abs(angle_deg), abs_tol=1e-9)


@given(st.integers(0, 4 * 10**18), st.floats(-90, 90), st.floats(-180, 180), st.floats(-100, 9000))
def test_every_checksum_holds_and_no_sentence_is_long(utc_ns, latitude_deg, longitude_deg, altitude_m):
    fix = Fix(utc_ns, latitude_deg, longitude_deg, altitude_m, 17.8, (1.0, -2.0), (0.01, 0.01, 0.02))
    for line in epoch_sentences(fix):
        body, checksum = line[1:-2].split(b"*")
        assert reduce(lambda a, b: a ^ b, body) == int(checksum, 16)
        assert len(line) <= 100
        assert line.endswith(b"\r\n")
