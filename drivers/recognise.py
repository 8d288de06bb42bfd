"""Which protocol speaks on a port, by a sample of its bytes."""


def recognise(data: bytes) -> list[tuple[str, str]]:
    """(driver, evidence) for all drivers that understand it, the likeliest first."""
    return []


def describe(data: bytes) -> str:
    """An addition to a message on bytes that are not understood; empty when nothing is recognised."""
    return "".join(f"; it looks like {evidence} (driver {driver})" for driver, evidence in recognise(data)[:1])
